"""Actions that change within a control step, at the resolution of the simulator's substeps."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

Schedule = list[tuple[np.ndarray, int]]  # actions (action,) and their numbers of substeps, in order


def split_schedule(schedule: Sequence[tuple[np.ndarray, int]], num_substeps: int) -> Iterator[Schedule]:
    """The parts of a schedule, one for each control step of `num_substeps`; an incomplete last part is left out."""
    part: Schedule = []
    room = num_substeps
    for control, remaining in schedule:
        while remaining:
            taken = min(remaining, room)
            part.append((control, taken))
            remaining, room = remaining - taken, room - taken
            if room == 0:
                yield part
                part, room = [], num_substeps


def control_step(task_env: Any, schedule: Schedule) -> Any:
    """One control step of a `dm_control` environment during which several controls act in turn.

    The task computes one reward, and may end the episode, after the last control. A schedule of one entry gives exactly
    the result of `task_env.step`.

    Args:
        task_env: A `dm_control.rl.control.Environment`.
        schedule: Controls in the actuators' range and their substeps; the substeps add up to one control step.

    Returns:
        The `dm_env.TimeStep`.
    """
    *early, (control, remaining) = schedule
    for earlier_control, num_substeps in early:
        task_env.task.before_step(earlier_control, task_env.physics)
        task_env.physics.step(num_substeps)
    whole = task_env._n_sub_steps
    task_env._n_sub_steps = remaining
    try:
        return task_env.step(control)
    finally:
        task_env._n_sub_steps = whole
