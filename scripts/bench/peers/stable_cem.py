"""CEMSolver of stable-worldmodel, with a model that returns the cost of action sequences."""

from __future__ import annotations

import importlib.util
import sys
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from bench.peers.problem import Problem, start_state, summed_rewards
from bench.peers.serve import Search, serve
from latentplan.models import State, WorldModel


class RewardCost:
    """The model with the interface of stable-worldmodel: `get_cost` of candidates (1, sample, horizon, action)."""

    def __init__(self, model: WorldModel, start: State) -> None:
        self.model, self.start = model, start

    def get_cost(self, info: dict[str, Tensor], candidates: Tensor) -> Tensor:
        """Minus the summed reward; actions are clamped here, because the solver has no bounds."""
        return -summed_rewards(self.model, self.start, candidates[0].clamp(-1.0, 1.0))[None]


def make_search(problem: Problem, model: WorldModel) -> Search:
    """A cold search from the problem's start."""
    import gymnasium

    load_solvers_alone()
    from stable_worldmodel.solver.cem import CEMSolver  # type: ignore[import-not-found]

    solver = CEMSolver(
        RewardCost(model, start_state(problem)),
        num_samples=problem.samples,
        var_scale=0.5,
        n_steps=problem.iterations,
        topk=problem.num_elites,
        device=problem.device,
        seed=problem.seed,
    )
    space = gymnasium.spaces.Box(-1.0, 1.0, (1, problem.action_dim))
    solver.configure(action_space=space, n_envs=1, config=SimpleNamespace(horizon=problem.horizon, action_block=1))
    info = {"start": torch.zeros(1, 1)}

    def search() -> Tensor:
        plan: dict[str, Any] = solver.solve(info)
        action: Tensor = plan["actions"][0, 0].clamp(-1.0, 1.0)
        return action

    return search


def load_solvers_alone() -> None:
    """Makes the solvers importable without the datasets and environments, which need other versions of packages."""
    found = importlib.util.find_spec("stable_worldmodel")
    if found is None:
        raise ModuleNotFoundError("stable_worldmodel is not installed")
    sys.modules.setdefault("stable_worldmodel", importlib.util.module_from_spec(found))  # found, and not executed


if __name__ == "__main__":
    serve(make_search)
