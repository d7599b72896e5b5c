"""Searches of `benchmark.py plan`: the project's planner, a plain CEM loop, and only the matrix products."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from bench.machine import read_clock
from bench.peers.problem import DTYPES, Problem, build_model, start_state, summed_rewards
from latentplan.planning import CEMPlanner

Search = Callable[[], Any]


def timed(search: Search, problem: Problem) -> Callable[[], float]:
    """A function that runs the search once and returns its duration in milliseconds."""
    device = torch.device(problem.device)

    @torch.no_grad()
    def search_ms() -> float:
        started = read_clock(device)
        search()
        return 1000.0 * (read_clock(device) - started)

    return search_ms


def planner_search(problem: Problem, dtype: str, batch: int = 1) -> Search:
    """A cold search of the project's planner from `batch` starts at once, without terminal value.

    The options are those of a plain cross-entropy method, which the other planners compute too.
    """
    model, start = build_model(problem, dtype), start_state(problem, batch)
    planner = CEMPlanner(
        action_dim=problem.action_dim,
        horizon=problem.horizon,
        num_samples=problem.samples,
        num_elites=problem.num_elites,
        num_iterations=problem.iterations,
        init_std=1.0,
        min_std=0.0,
        terminal_value=False,
        final="mean",
        noise_beta=0.0,
        keep_elite_fraction=0.0,
    )
    return lambda: planner.plan(model, start)


def plain_search(problem: Problem) -> Search:
    """A cold search by a plain cross-entropy method, in float32."""
    model, start = build_model(problem, "float32"), start_state(problem)
    shape = (problem.horizon, problem.action_dim)

    def search() -> Tensor:
        mean, std = (fill(shape, device=problem.device) for fill in (torch.zeros, torch.ones))
        for _ in range(problem.iterations):
            noise = torch.randn(problem.samples, *shape, device=problem.device)
            actions = (mean + std * noise).clamp(-1.0, 1.0)
            total = summed_rewards(model, start, actions)
            elites = actions[total.topk(problem.num_elites).indices]
            mean, std = elites.mean(0), elites.std(0)
        return mean[0]

    return search


def product_shapes(problem: Problem) -> list[tuple[int, int, int]]:
    """Sizes (rows, in, out) of the matrix products in one iteration: of each step, then of the reward head.

    The prior counts with its mean only, because a search does not use its standard deviation.
    """
    model, rows = problem.model_config, problem.samples
    latent, deter, hidden = model.latent_dim, model.deter_dim, model.hidden_dim
    step = [
        (rows, latent + problem.action_dim, hidden),
        (rows, hidden + deter, 3 * deter),
        (rows, deter, hidden),
        (rows, hidden, latent),
    ]
    all_rows = rows * problem.horizon
    head = [(all_rows, deter + latent, hidden), (all_rows, hidden, hidden), (all_rows, hidden, model.num_bins)]
    return step * problem.horizon + head


def matrix_products(problem: Problem, dtype: str) -> Search:
    """Only the matrix products of a search, written into allocated memory."""
    shapes = product_shapes(problem)
    operands = {
        (rows, inner, outer): [
            torch.randn(size, device=problem.device).to(DTYPES[dtype])
            for size in ((rows, inner), (inner, outer), (rows, outer))
        ]
        for rows, inner, outer in set(shapes)
    }

    def search() -> None:
        for _ in range(problem.iterations):
            for shape in shapes:
                left, right, out = operands[shape]
                torch.mm(left, right, out=out)

    return search
