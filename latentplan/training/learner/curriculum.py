"""Curriculum: the agent first learns the rewards of another task, and the run's own rewards afterwards.

The simulator labels every frame with the rewards of all tasks of the domain and with named quantities, from which the
rewards of other tasks are computed for frames that are in replay.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import lightning
import torch
from torch import Tensor

from latentplan.config import Config
from latentplan.objectives.box import scoring_degree
from latentplan.objectives.expression import Node, evaluate
from latentplan.replay.buffer import Batch
from latentplan.training.checks import parse_curriculum_task
from latentplan.training.state import RunState

if TYPE_CHECKING:
    from latentplan.training.learner.module import Learner


class Curriculum(lightning.Callback):
    """Replaces replayed rewards by the rewards of `curriculum_task` in the first `curriculum_frames` frames of a run.

    The value head is then reset. Otherwise the old values of states that the agent no longer visits would stay high and
    attract the agent. A run that collects nothing has no curriculum.

    Args:
        config: Settings of the run. Rewards stay unchanged if the curriculum's task is the run's own task or objective.
        labels: Quantities that label each frame, in the order of their columns, and their scales.
        state: Clocks of the run.

    Attributes:
        note: Text about the curriculum for the task line that a run prints at its start; empty without another task.

    Raises:
        UserError: `learning.curriculum_task` is neither a task nor an expression over the labels.
    """

    def __init__(self, config: Config, labels: Mapping[str, float], state: RunState) -> None:
        self.state = state
        self._frames = config.learning.curriculum_frames if config.collection.enabled else 0
        self._repeat = config.env.action_repeat
        self._terms: tuple[tuple[float, Node], ...] = ()
        self._columns, self.note = {name: column for column, name in enumerate(labels)}, ""
        task = config.learning.curriculum_task
        own = config.env.task if config.env.objective is None else config.env.objective
        if self._frames > 0 and task not in (None, own):
            self._terms = parse_curriculum_task(task, labels)
            self.note = f"; first {task}, for {self._frames:,} frames"

    def __call__(self, batch: Batch) -> Batch:
        """The batch with the rewards of the curriculum's task, or the same batch once the curriculum is over."""
        if not self._terms or self._is_over():
            return batch
        values = {name: batch.labels[..., column] for name, column in self._columns.items()}
        per_step = sum(weight * evaluate(node, values.__getitem__, scoring_degree) for weight, node in self._terms)
        per_step = torch.as_tensor(per_step).expand(batch.labels.shape[:2])  # (batch, time + 1)
        return batch._replace(rewards=sum_rewards(per_step, self._repeat))

    def on_train_epoch_start(self, trainer: lightning.Trainer, learner: Learner) -> None:  # type: ignore[override]
        """Reset the value head in the first epoch that learns the run's own reward."""
        if self._terms and self._is_over() and not self.state.curriculum_over:
            learner.reset_value_head()
            self.state.curriculum_over = True

    def _is_over(self) -> bool:
        return self.state.env_frames >= self._frames


def sum_rewards(values: Tensor, action_repeat: int) -> Tensor:
    """Reward per decision, from the reward per control step at the frames before and after the decision.

    Args:
        values: Reward of one control step at each frame, (batch, time + 1).
        action_repeat: Control steps per decision; rewards between two frames are interpolated linearly.

    Returns:
        Sum of the control steps' rewards over each decision, (batch, time).
    """
    before, after = values[:, :-1], values[:, 1:]
    return before * (action_repeat - 1) / 2 + after * (action_repeat + 1) / 2
