"""MPPI of pytorch_mppi: one command per iteration, with the nominal trajectory kept between commands."""

from __future__ import annotations

import torch
from pytorch_mppi import MPPI  # type: ignore[import-not-found]
from torch import Tensor

from bench.peers.problem import Problem, next_features, rewards_at, start_state
from bench.peers.serve import Search, serve
from latentplan.models import WorldModel


def make_search(problem: Problem, model: WorldModel) -> Search:
    """A search from the problem's start."""
    features = start_state(problem).features[0]
    ones = torch.ones(problem.action_dim, device=problem.device)
    controller = MPPI(
        lambda rows, action: next_features(model, rows, action),
        lambda rows, action: -rewards_at(model, rows),
        nx=len(features),
        noise_sigma=0.25 * torch.eye(problem.action_dim, device=problem.device),
        num_samples=problem.samples,
        horizon=problem.horizon,
        device=problem.device,
        u_min=-ones,
        u_max=ones,
    )

    def search() -> Tensor:
        controller.reset()
        for _ in range(problem.iterations):
            action: Tensor = controller.command(features, shift_nominal_trajectory=False)
        return action

    return search


if __name__ == "__main__":
    serve(make_search)
