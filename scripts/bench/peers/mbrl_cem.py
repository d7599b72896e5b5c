"""CEMOptimizer of mbrl-lib, with an objective that steps the model."""

from __future__ import annotations

import torch
from mbrl.planning.trajectory_opt import CEMOptimizer  # type: ignore[import-not-found]
from torch import Tensor

from bench.peers.problem import ELITE_SHARE, Problem, start_state, summed_rewards
from bench.peers.serve import Search, serve
from latentplan.models import WorldModel


def make_search(problem: Problem, model: WorldModel) -> Search:
    """A cold search from the problem's start."""
    shape, device = (problem.horizon, problem.action_dim), torch.device(problem.device)
    optimizer = CEMOptimizer(
        num_iterations=problem.iterations,
        elite_ratio=ELITE_SHARE,
        population_size=problem.samples,
        lower_bound=torch.full(shape, -1.0).tolist(),
        upper_bound=torch.full(shape, 1.0).tolist(),
        alpha=0.1,
        device=device,
        return_mean_elites=True,
    )
    start = start_state(problem)

    def objective(population: Tensor) -> Tensor:
        return summed_rewards(model, start, population)

    return lambda: optimizer.optimize(objective, x0=torch.zeros(shape, device=device))[0]


if __name__ == "__main__":
    serve(make_search)
