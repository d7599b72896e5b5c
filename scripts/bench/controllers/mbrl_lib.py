"""CEM, iCEM and MPPI of mbrl-lib; the shifted last solution starts the next search."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from typing import Any

import torch
from mbrl.planning.trajectory_opt import (  # type: ignore[import-not-found]
    CEMOptimizer,
    ICEMOptimizer,
    MPPIOptimizer,
)
from torch import Tensor

from bench.controllers.serve import Entry, serve
from bench.controllers.task import Act, Task
from bench.peers.problem import ELITE_SHARE

DECAY = 1.3  # of iCEM's population, the library's own
LAST = tuple({"return_mean_elites": choice} for choice in (True, False))
MPPI_CHOICES = tuple({"gamma": gamma, "beta": beta} for gamma, beta in product((0.3, 3.0, 30.0), (0.5, 0.9)))


def make_with(kind: Any, **own: Any) -> Callable[[Task, Sequence[int]], Act]:
    """A function that makes a controller of a class of the library; `own` are the values of its configuration."""

    def make(task: Task, seeds: Sequence[int]) -> Act:
        shape, total_cost = (task.problem.horizon, task.problem.action_dim), task.total_cost()
        shares = [DECAY**-iteration for iteration in range(task.iterations)]
        is_decaying = kind is ICEMOptimizer
        population = task.samples * task.iterations / sum(shares) if is_decaying else task.samples
        optimizer = kind(
            num_iterations=task.iterations,
            population_size=int(population),
            lower_bound=torch.full(shape, -1.0).tolist(),
            upper_bound=torch.full(shape, 1.0).tolist(),
            device=torch.device("cpu"),
            **own,
            **task.settings,
        )
        solution = torch.zeros(shape)

        def act(state: Tensor) -> Tensor:
            nonlocal solution
            best = optimizer.optimize(lambda units: -total_cost(state, units), x0=solution)
            solution = torch.cat([best[1:], torch.zeros(1, shape[1])])
            return best[:1]

        return task.unscaled(act)

    return make


if __name__ == "__main__":
    cem = make_with(CEMOptimizer, elite_ratio=ELITE_SHARE, alpha=0.1)
    icem = make_with(
        ICEMOptimizer,
        elite_ratio=ELITE_SHARE,
        alpha=0.1,
        population_decay_factor=DECAY,
        colored_noise_exponent=2.0,
        keep_elite_frac=0.1,
    )
    serve(
        {
            "CEM": Entry(cem, choices=LAST),
            "iCEM": Entry(icem, choices=LAST),
            "MPPI": Entry(make_with(MPPIOptimizer, sigma=1.0), choices=MPPI_CHOICES),
        }
    )
