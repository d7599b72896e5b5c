"""What is learned first: another reward, on the way to the run's own.

The simulator tells with every frame what each task of the domain pays there, and the quantities that rewards can be
made of, so one stream of experience serves all.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import lightning
import torch
from torch import Tensor

from latentplan.config import Config, UserError
from latentplan.config.quantities import TASK_PREFIX
from latentplan.objectives.box import scoring_degree
from latentplan.objectives.expression import Name, Node, evaluate
from latentplan.objectives.parser import parse_reward
from latentplan.replay.buffer import Batch
from latentplan.training.state import RunState

if TYPE_CHECKING:
    from latentplan.training.learner.module import Learner


class Curriculum(lightning.Callback):
    """Replaces replayed rewards by those of another task or expression until so many frames have been collected.

    When they have, the value begins anew: where the agent no longer goes, an old value would stay high, and lure it.

    Args:
        config: Settings of the run: what comes first, and for how many simulator frames. Nothing is replaced when that
            is the run's own task, or its own objective where it has one.
        labels: The quantities that come with each frame, in their order, and their scales.
        state: Clocks of the run.

    Attributes:
        note: What there is to say of it, to be appended to the run's task; empty without another task.

    Raises:
        UserError: The simulator does not tell what that task pays, and it is no expression of what is told.
    """

    def __init__(self, config: Config, labels: Mapping[str, float], state: RunState) -> None:
        self.state = state
        self._frames, self._repeat = config.learning.curriculum_frames, config.env.action_repeat
        self._terms: tuple[tuple[float, Node], ...] = ()
        self._columns, self.note = {name: column for column, name in enumerate(labels)}, ""
        first = config.learning.curriculum_task
        own = config.env.task if config.env.objective is None else config.env.objective
        if self._frames > 0 and first not in (None, own):
            self._terms = _read(first, labels)
            self.note = f"; first {first}, for {self._frames:,} frames"

    def __call__(self, batch: Batch) -> Batch:
        """The batch as it is to be learned from now."""
        if not self._terms or self._is_over():
            return batch
        values = {name: batch.labels[..., column] for name, column in self._columns.items()}
        paid = sum(weight * evaluate(node, values.__getitem__, scoring_degree) for weight, node in self._terms)
        return batch._replace(rewards=summed_reward(torch.as_tensor(paid).expand(batch.labels.shape[:2]), self._repeat))

    def on_train_epoch_start(self, trainer: lightning.Trainer, learner: Learner) -> None:  # type: ignore[override]
        """Have the value begun anew in the first epoch that learns the run's own reward."""
        if self._terms and self._is_over() and not self.state.curriculum_over:
            learner.forget_values()
            self.state.curriculum_over = True

    def _is_over(self) -> bool:
        return self.state.env_frames >= self._frames


def _read(text: str, labels: Mapping[str, float]) -> tuple[tuple[float, Node], ...]:
    """The weighted terms of a task's name, or of an expression over quantities."""
    if TASK_PREFIX + text in labels:
        return ((1.0, Name(TASK_PREFIX + text)),)
    try:
        return parse_reward(text, labels, "learning.curriculum_task").terms
    except UserError as error:
        tasks = [name.removeprefix(TASK_PREFIX) for name in labels if name.startswith(TASK_PREFIX)]
        raise UserError(
            f"learning.curriculum_task {text!r} is unknown; this body's simulator tells what these tasks pay: "
            f"{', '.join(tasks) or 'none'}; as an expression: {error}"
        ) from None


def summed_reward(values: Tensor, action_repeat: int) -> Tensor:
    """What a decision earns, from what one control step pays at the frames before and after it.

    Args:
        values: Reward of a control step at each frame, (batch, time + 1).
        action_repeat: Control steps per decision; what those between two frames pay is interpolated.

    Returns:
        Their sum over each decision, (batch, time).
    """
    before, after = values[:, :-1], values[:, 1:]
    return before * (action_repeat - 1) / 2 + after * (action_repeat + 1) / 2
