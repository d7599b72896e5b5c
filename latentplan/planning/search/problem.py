"""The problem that a search solves, and its limits in the form that the search uses."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from latentplan.config.checks import shown
from latentplan.config.planner import SearchOptions
from latentplan.planning.model import Model, State
from latentplan.planning.objectives import Constraint, Objective, Term, check_constraints
from latentplan.planning.plan import Iteration
from latentplan.planning.search.purity import FirstSearches
from latentplan.planning.search.space import Bounds, Space


@dataclass(frozen=True)
class Problem:
    """The problem that one search solves.

    Attributes:
        model: The model in which action sequences are imagined.
        state: Start of the plans, rows (batch,).
        objective: Maximised; None is the predicted return.
        constraints: Violations that candidates must avoid.
        low: Lowest action, (1 or batch, 1 or horizon, action).
        high: Highest action, (1 or batch, 1 or horizon, action).
        init_mean: Mean at the start of a cold search and end of a shifted plan, (1 or batch, 1 or horizon, action);
            None takes the middle of the bounds.
        init_std: Standard deviation at the start of the search, (1, 1, action); None takes a quarter of the action
            range.
        discount: Discount per model step, in (0, 1].
        choices: By dimension, the values of discrete actions.
        last_action: The action executed last, (batch, action); None takes it from the previous plan.
        first_searches: The models that were watched for changes of their inputs; the search watches a new model, and
            adds the model if it changed none.

    Raises:
        TypeError: The objective is neither None nor a function.
    """

    model: Model
    state: State
    objective: Term | None
    constraints: Sequence[Constraint]
    low: Tensor
    high: Tensor
    init_mean: Tensor | None
    init_std: Tensor | None
    discount: float
    choices: Mapping[int, Sequence[float]]
    last_action: Tensor | None
    first_searches: FirstSearches

    def __post_init__(self) -> None:
        """Refuses an objective that is not a function."""
        if self.objective is not None and not callable(self.objective):
            hint = "; only an agent's set_objective() takes text" if isinstance(self.objective, str) else ""
            raise TypeError(f"objective must be a function of rollouts, got {shown(self.objective)}{hint}")


@dataclass(frozen=True)
class View:
    """What a caller sees of a search.

    Attributes:
        keep: `candidates` or `states`, which the plan keeps; None keeps neither.
        callback: Called after each iteration.
    """

    keep: str | None = None
    callback: Callable[[Iteration], Any] | None = None

    @property
    def is_open(self) -> bool:
        """Whether iterations are described at all."""
        return self.keep is not None or self.callback is not None


def split_limits(constraints: Sequence[Constraint]) -> tuple[list[Tensor], list[Constraint]]:
    """Returns the rate limits among the constraints, which the search space holds, and the other constraints.

    Raises:
        TypeError: The constraints are no sequence of functions.
    """
    check_constraints(constraints)
    limits, others = [], []
    for constraint in constraints:
        if isinstance(constraint, Objective) and constraint.max_change is not None:
            limits.append(torch.tensor(constraint.max_change, dtype=torch.float64, device="cpu"))
        else:
            others.append(constraint)
    return limits, others


def find_max_change(limits: Sequence[Tensor], bounds: Bounds) -> Tensor:
    """Returns the largest change of an action per step under rate limits, (action,).

    Args:
        limits: Rate limits, each (1,) or (action,).
        bounds: Bounds of the actions.

    Raises:
        ValueError: A limit has another number of dimensions than the actions.
    """
    for limit in limits:
        if len(limit) not in (1, bounds.action_dim):
            raise ValueError(f"rate_limit is for {len(limit)} dimensions, an action has {bounds.action_dim}")
    largest = torch.stack([limit.expand(bounds.action_dim) for limit in limits]).amin(dim=0).to(bounds.low)
    if bounds.choices is None:
        return largest
    return largest.index_fill(0, bounds.choices.dims, float("inf"))  # a value is taken or not, so it has no rate


def make_space(
    options: SearchOptions,
    bounds: Bounds,
    horizon: int,
    limits: Sequence[Tensor],
    find_last_action: Callable[[], Tensor] | None,
) -> Space:
    """Returns the space of a search.

    Args:
        options: Options of the search.
        bounds: Bounds of the actions.
        horizon: Number of actions of a plan.
        limits: Rate limits, each (1,) or (action,).
        find_last_action: Returns the action executed last, (batch, action); called for rate limits only.
    """
    max_change = last_action = None
    if limits:
        max_change = find_max_change(limits, bounds)
        last_action = None if find_last_action is None else find_last_action()
    return Space(
        bounds,
        horizon,
        spline=options.action_spline,
        num_knots=options.knots(horizon),
        overshoot=options.overshoot,
        max_change=max_change,
        last_action=last_action,
    )


def find_spreads(bounds: Bounds, init_std: Tensor | None, min_std: float) -> tuple[Tensor, Tensor]:
    """Returns the std at the start and the floor of the sampling std, (1 or batch, 1 or horizon, action).

    Args:
        bounds: Bounds of the actions.
        init_std: Standard deviation at the start; None takes a quarter of the range, which the floor may not exceed.
        min_std: The floor.
    """
    floor = torch.full_like(bounds.low, min_std)
    if init_std is not None:
        return init_std, floor
    quarter = (bounds.high - bounds.low) / 4
    return quarter, torch.minimum(floor, quarter)


def fit_steps(value: Tensor, name: str, batch: int, horizon: int) -> Tensor:
    """Returns a value (1 or batch, 1 or more steps, action) with the steps of a plan.

    Raises:
        ValueError: The value is for another number of environments or for too few steps.
    """
    environments, steps, _ = value.shape
    if environments not in (1, batch) or (steps != 1 and steps < horizon):
        given = f"{environments} environments and {steps} steps"
        raise ValueError(f"{name} is for {given}, the plan for {batch} and {horizon}")
    return value[:, :horizon]
