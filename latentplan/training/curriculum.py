"""What is learned first: the reward of a sibling task, on the way to the run's own.

The simulator tells with every frame what each task of the domain pays there, so one stream of experience serves all.
"""

from __future__ import annotations

from collections.abc import Collection

from torch import Tensor

from latentplan.config import Config, UserError
from latentplan.config.quantities import TASK_PREFIX
from latentplan.replay import Batch


class Curriculum:
    """Replaces replayed rewards by those of another task until so many frames have been collected.

    Args:
        config: Settings of the run: which task comes first, and for how many simulator frames. Nothing is replaced when
            that is the run's own task, or when the run has an objective in a task's place.
        labels: Names of the quantities that come with each frame, in their order.

    Raises:
        UserError: The simulator does not tell what that task pays.
    """

    def __init__(self, config: Config, labels: Collection[str]) -> None:
        self._frames, self._repeat = config.learning.curriculum_frames, config.env.action_repeat
        self._column = None
        first = config.learning.curriculum_task
        if first not in (None, config.env.task) and config.env.objective is None:
            tasks = [name.removeprefix(TASK_PREFIX) for name in labels if name.startswith(TASK_PREFIX)]
            if first not in tasks:
                raise UserError(
                    f"learning.curriculum_task {first!r} is unknown; this body's simulator tells what "
                    f"these tasks pay: {', '.join(tasks) or 'none'}"
                )
            self._column = list(labels).index(TASK_PREFIX + first)

    def __call__(self, batch: Batch, env_frames: int) -> Batch:
        """The batch as it is to be learned from after so many simulator frames of the run."""
        if self._column is None or env_frames >= self._frames:
            return batch
        return batch._replace(rewards=summed_reward(batch.labels[..., self._column], self._repeat))


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
