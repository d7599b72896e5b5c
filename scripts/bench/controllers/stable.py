"""Solvers of stable-worldmodel: CEM, iCEM, MPPI and predictive sampling; the shifted last plan starts the next."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from types import SimpleNamespace
from typing import Any

import gymnasium
import torch
from torch import Tensor

from bench.controllers.serve import Entry, serve
from bench.controllers.task import Act, Task
from bench.peers.stable_cem import load_solvers_alone

load_solvers_alone()
from stable_worldmodel.solver.cem import CEMSolver  # type: ignore[import-not-found]  # noqa: E402
from stable_worldmodel.solver.icem import ICEMSolver  # type: ignore[import-not-found]  # noqa: E402
from stable_worldmodel.solver.mppi import MPPISolver  # type: ignore[import-not-found]  # noqa: E402

WIDTHS = tuple({"var_scale": std} for std in (0.5, 1.0))  # the solvers use it as a standard deviation
ICEM_CHOICES = tuple(width | {"return_mean": mean} for width, mean in product(WIDTHS, (True, False)))
MPPI_CHOICES = tuple(width | {"temperature": value} for width, value in product(WIDTHS, (0.03, 0.5, 3.0)))


class TotalCost:
    """The task with the interface of stable-worldmodel: `get_cost` of candidates (1, sample, horizon, action)."""

    def __init__(self, task: Task) -> None:
        self._total_cost = task.total_cost()
        self.state = torch.zeros(0)

    def get_cost(self, info: dict[str, Tensor], candidates: Tensor) -> Tensor:
        """The cost of each candidate from the present state."""
        return self._total_cost(self.state, candidates[0])[None]


def make_with(kind: Any, **own: Any) -> Callable[[Task, Sequence[int]], Act]:
    """A function that makes a controller of a solver."""

    def make(task: Task, seeds: Sequence[int]) -> Act:
        problem, cost = task.problem, TotalCost(task)
        solver = kind(
            cost,
            num_samples=task.samples,
            n_steps=task.iterations,
            topk=task.num_elites,
            seed=seeds[0],
            **own,
            **task.settings,
        )
        space = gymnasium.spaces.Box(-1.0, 1.0, (1, problem.action_dim))
        solver.configure(action_space=space, n_envs=1, config=SimpleNamespace(horizon=problem.horizon, action_block=1))
        rest: Tensor | None = None

        def act(state: Tensor) -> Tensor:
            nonlocal rest
            cost.state = state
            plan: Tensor = solver.solve({"start": torch.zeros(1, 1)}, init_action=rest)["actions"]
            rest = plan[:, 1:].clone()
            return plan[:, 0].clone()

        return task.unscaled(act)

    return make


if __name__ == "__main__":
    serve(
        {
            "CEM": Entry(make_with(CEMSolver), choices=WIDTHS),
            "iCEM": Entry(make_with(ICEMSolver), choices=ICEM_CHOICES),
            "MPPI": Entry(make_with(MPPISolver), choices=MPPI_CHOICES),
        }
    )
