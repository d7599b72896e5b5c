"""This library's planners, with their own defaults: only the problem and the budget are named.

A planner `NAME-wide` starts with a standard deviation of half the range of the actions, in place of a quarter.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch

from bench.controllers.serve import Entry, serve
from bench.controllers.task import Act, Task
from latentplan.planning import PLANNERS, ModelPredictiveController, make_planner


def controller(name: str, is_wide: bool = False) -> Callable[[Task, Sequence[int]], Act]:
    """A function that makes the controller of a registered planner."""

    def make(task: Task, seeds: Sequence[int]) -> Act:
        problem = task.problem
        bounds: dict[str, Any] = {"action_low": problem.action_low, "action_high": problem.action_high}
        size: dict[str, Any] = {"action_dim": problem.action_dim, "horizon": problem.horizon}
        if getattr(make_planner(name, **size), "num_iterations", None) == 1:  # it spends its budget in one iteration
            budget: dict[str, Any] = {"num_samples": task.samples * task.iterations}
        else:
            iterations = {"num_iterations": task.iterations, "warm_start_iterations": task.iterations}
            budget = {"num_samples": task.samples, **iterations}
        width: dict[str, Any] = {"init_std": task.scale[1]} if is_wide else {}
        planner = make_planner(name, **size, **bounds, **budget, **width, **task.settings)
        streams = [torch.Generator().manual_seed(seed) for seed in seeds]
        return ModelPredictiveController(planner, task.model(), generator=streams).act

    return make


if __name__ == "__main__":
    narrow = {name: Entry(controller(name), is_batched=True) for name in PLANNERS}
    serve(narrow | {f"{name}-wide": Entry(controller(name, is_wide=True), is_batched=True) for name in PLANNERS})
