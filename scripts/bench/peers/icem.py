"""iCEM of pytorch_icem, with the rewards of all steps computed at once."""

from __future__ import annotations

import torch
from pytorch_icem import iCEM  # type: ignore[import-not-found]
from torch import Tensor

from bench.peers.problem import Problem, next_features, rewards_at, start_state
from bench.peers.serve import Search, serve
from latentplan.models import WorldModel

INIT_STD = 0.5


def make_search(problem: Problem, model: WorldModel) -> Search:
    """A cold search from the problem's start."""
    features = start_state(problem).features[0]
    controller = iCEM(
        lambda rows, action: next_features(model, rows, action.clamp(-1.0, 1.0)),  # iCEM here has no action bounds
        lambda rows, actions: -rewards_at(model, rows).sum(-1),
        nx=len(features),
        nu=1,
        sigma=INIT_STD,
        num_samples=problem.samples,
        num_elites=problem.num_elites,
        horizon=problem.horizon,
        warmup_iters=problem.iterations,
        device=problem.device,
    )
    # The constructor accepts sigma for one-dimensional actions only; the search broadcasts over any number.
    controller.nu = problem.action_dim
    controller.sigma = torch.full((problem.action_dim,), INIT_STD, device=problem.device)

    def search() -> Tensor:
        controller.reset()
        action: Tensor = controller.command(features)
        return action

    return search


if __name__ == "__main__":
    serve(make_search)
