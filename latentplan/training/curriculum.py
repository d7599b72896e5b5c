"""What is learned first: the reward of a sibling task, on the way to the run's own.

The simulator tells with every frame what each task of the domain pays there, so one stream of experience serves all.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING

import lightning
from torch import Tensor

from latentplan.config import Config, UserError
from latentplan.config.quantities import TASK_PREFIX
from latentplan.replay import Batch
from latentplan.training.state import RunState

if TYPE_CHECKING:
    from latentplan.training.module import Learner


class Curriculum(lightning.Callback):
    """Replaces replayed rewards by those of another task until so many frames have been collected.

    When they have, the value begins anew: where the agent no longer goes, an old value would stay high, and lure it.

    Args:
        config: Settings of the run: which task comes first, and for how many simulator frames. Nothing is replaced when
            that is the run's own task; a run with an objective has none.
        labels: Names of the quantities that come with each frame, in their order.
        state: Clocks of the run.

    Attributes:
        note: What there is to say of it, to be appended to the run's task; empty without another task.

    Raises:
        UserError: The simulator does not tell what that task pays.
    """

    def __init__(self, config: Config, labels: Collection[str], state: RunState) -> None:
        self.state = state
        self._frames, self._repeat = config.learning.curriculum_frames, config.env.action_repeat
        self._column, self.note = None, ""
        first = config.learning.curriculum_task
        own = config.env.task if config.env.objective is None else None
        if self._frames > 0 and first not in (None, own):
            tasks = [name.removeprefix(TASK_PREFIX) for name in labels if name.startswith(TASK_PREFIX)]
            if first not in tasks:
                raise UserError(
                    f"learning.curriculum_task {first!r} is unknown; this body's simulator tells what "
                    f"these tasks pay: {', '.join(tasks) or 'none'}"
                )
            self._column = list(labels).index(TASK_PREFIX + first)
            self.note = f"; first {first}, for {self._frames:,} frames"

    def __call__(self, batch: Batch) -> Batch:
        """The batch as it is to be learned from now."""
        if self._column is None or self._is_over():
            return batch
        return batch._replace(rewards=summed_reward(batch.labels[..., self._column], self._repeat))

    def on_train_epoch_start(self, trainer: lightning.Trainer, learner: Learner) -> None:  # type: ignore[override]
        """Have the value begun anew in the first epoch that learns the run's own reward."""
        if self._column is not None and self._is_over() and not self.state.curriculum_over:
            learner.forget_values()
            self.state.curriculum_over = True

    def _is_over(self) -> bool:
        return self.state.env_frames >= self._frames


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
