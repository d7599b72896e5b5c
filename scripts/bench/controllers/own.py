"""This library's planners, with their own defaults: only the problem and the budget are named.

All sequences that a decision evaluates count: those of the iterations, the mean and the best one that `final` compares,
and those of the gradient ascent. `num_samples` is what the budget leaves for each iteration.

A planner `NAME-tuned` starts with a larger standard deviation than its default, a quarter of the range of the actions,
may have smoother noise, may search outside of the bounds, and may start every search cold: one of `CHOICES` is taken
for each problem, as the settings of other libraries are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from typing import Any

import torch

from bench.controllers.serve import Entry, serve
from bench.controllers.task import GRADIENT_COST, Act, Task
from latentplan.planning import PLANNERS, ModelPredictiveController, make_planner

CHOICES: tuple[dict[str, Any], ...] = tuple(
    {"width": width, "overshoot": overshoot, "noise_beta": beta, "warm_start": is_warm}  # width: std in half ranges
    for width, overshoot, beta, is_warm in product((1.0, 1.5), (0.0, 3.0), (2.0, 3.0), (True, False))
)


def controller(name: str) -> Callable[[Task, Sequence[int]], Act]:
    """A function that makes the controller of a registered planner, with its defaults but for a choice of `CHOICES`."""

    def make(task: Task, seeds: Sequence[int]) -> Act:
        problem = task.problem
        bounds: dict[str, Any] = {"action_low": problem.action_low, "action_high": problem.action_high}
        size: dict[str, Any] = {"action_dim": problem.action_dim, "horizon": problem.horizon}
        budget: dict[str, Any] = budget_options(make_planner(name, **size), task)
        chosen: dict[str, Any] = dict(task.settings)
        if "width" in chosen:
            chosen["init_std"] = chosen.pop("width") * task.scale[1]
        planner = make_planner(name, **size, **bounds, **budget, **chosen)
        streams = [torch.Generator().manual_seed(seed) for seed in seeds]
        return ModelPredictiveController(planner, task.model(), generator=streams).act

    return make


def budget_options(planner: Any, task: Task) -> dict[str, int]:
    """The options with which a planner with these defaults evaluates `samples` times `iterations` sequences.

    Args:
        planner: The planner with its defaults.
        task: The task; a budget that is too small for what follows the iterations is exceeded.
    """
    compared = 2 if planner.final == "better" else 0
    ascent = GRADIENT_COST * (1 + planner.gradient_steps) if planner.gradient_steps else 0  # the start and each step
    iterations = 1 if planner.num_iterations == 1 else task.iterations
    samples = (task.samples * task.iterations - compared - ascent) // iterations
    return {"num_samples": max(2, samples), "num_iterations": iterations, "warm_start_iterations": iterations}


if __name__ == "__main__":
    default = {name: Entry(controller(name), is_batched=True) for name in PLANNERS}
    tuned = {f"{name}-tuned": Entry(controller(name), is_batched=True, choices=CHOICES) for name in PLANNERS}
    serve(default | tuned)
