"""The task of a planner in closed loop: a problem, a budget, and the model, which counts its evaluations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from bench.peers.problem import count_elites
from bench.problems import PROBLEMS, ControlProblem
from bench.simulated_problems import SIMULATED
from latentplan.config.parsing import raise_unknown

NAMES = (*PROBLEMS, *SIMULATED)
GRADIENT_COST = 3  # a backward pass costs about two forward
Act = Callable[[Tensor], Tensor]  # act(state (rows, state)) -> action (rows, action), within the problem's bounds


def find_problem(name: str) -> ControlProblem:
    """The problem of a name.

    Raises:
        UserError: There is no problem of this name.
    """
    if name in PROBLEMS:
        return PROBLEMS[name]
    if name not in SIMULATED:
        raise_unknown("problem", name, NAMES)
    return SIMULATED[name]()


@dataclass(kw_only=True)
class Task:
    """What a planner is given.

    Attributes:
        problem: The control problem.
        samples: Candidates per iteration.
        iterations: Iterations of each decision.
        settings: Settings of the planner, which replace its own.
        rows: Number of model steps that were evaluated so far; a step with gradients counts as `GRADIENT_COST`.
    """

    problem: ControlProblem
    samples: int
    iterations: int
    settings: dict[str, Any] = field(default_factory=dict)
    rows: int = 0

    @property
    def num_elites(self) -> int:
        """A tenth of the candidates, at least two."""
        return count_elites(self.samples)

    @property
    def scale(self) -> tuple[float, float]:
        """Middle and half width of the bounds: an action is middle + half width * unit, the unit in [-1, 1]."""
        low, high = self.problem.action_low, self.problem.action_high
        return (low + high) / 2, (high - low) / 2

    def model(self) -> CountingModel:
        """The model of the problem, for actions within its bounds."""
        return CountingModel(self.problem.model(), self)

    def stepper(self) -> Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]:
        """`step(state, unit) -> (next_state, cost)`, for actions given in [-1, 1] and clamped there."""
        model, (middle, half) = self.model(), self.scale

        def step(state: Tensor, unit: Tensor) -> tuple[Tensor, Tensor]:
            following, reward = model.step(state, middle + half * unit.clamp(-1.0, 1.0))
            return following, -reward

        return step

    def total_cost(self) -> Callable[[Tensor, Tensor], Tensor]:
        """`total_cost(state (1, state), units (rows, horizon, action)) -> (rows,)`, the summed cost of sequences."""
        step = self.stepper()

        def total_cost(state: Tensor, units: Tensor) -> Tensor:
            state = state.expand(len(units), -1)
            total = torch.zeros(len(units))
            for unit in units.unbind(dim=1):
                state, cost = step(state, unit)
                total = total + cost
            return total

        return total_cost

    def unscaled(self, unit_act: Act) -> Act:
        """The same controller with actions within the bounds, from one whose actions lie in [-1, 1]."""
        middle, half = self.scale
        return lambda state: middle + half * unit_act(state).clamp(-1.0, 1.0)


class CountingModel:
    """A model that counts its steps in `task.rows`; `rollout` exists where the wrapped model has one."""

    def __init__(self, model: Any, task: Task) -> None:
        self._model, self._task = model, task
        if hasattr(model, "rollout"):  # a planner detects an optional method by the attribute
            self.rollout = self._rollout

    def step(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """The step of the wrapped model."""
        self._count(len(action))
        following: tuple[Tensor, Tensor] = self._model.step(state, action)
        return following

    def _rollout(self, state: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        self._count(actions.shape[0] * actions.shape[1])
        result: tuple[Tensor, Tensor] = self._model.rollout(state, actions)
        return result

    def _count(self, steps: int) -> None:
        self._task.rows += GRADIENT_COST * steps if torch.is_grad_enabled() else steps
