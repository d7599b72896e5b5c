"""Objectives that a search maximises, and constraints that it satisfies.

Terms are added and multiplied, with each other and with numbers:

    learned_return() + terminal_value() + 0.1 * action_penalty() + 5 * goal_term(goal)

Every term is maximised, so penalties are negative. A function `function(rollout) -> (rows,)` is a term as well. A term
can be sent to another process if its functions and tensors can.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from einops import rearrange, repeat
from torch import Tensor
from torch.nn import functional

from latentplan.config.checks import shown
from latentplan.planning.model import Model, State, call_with, check_shape, require, supports

Term = Callable[["Rollout"], Tensor]  # the value of each row, (rows,), maximised
Constraint = Callable[["Rollout"], Tensor]  # the violation of each row, (rows,); at most 0 where it is satisfied
View = Callable[[Model], Model]  # see `conditioned`


@dataclass(frozen=True)
class Rollout:
    """Imagined trajectories, one per row; rows are (batch sample particle), the batch slowest.

    Attributes:
        model: The model that imagined the trajectories.
        batch: Number of environments that share the rows.
        num_particles: Number of rollouts of each candidate.
        actions: Actions, (rows, horizon, action).
        rewards: Predicted reward of each step, (rows, horizon), float32 or float64.
        weights: Discount of each step and of the last state, (horizon + 1,); or (rows, horizon + 1) if the discount
            includes the probability that the episode goes on.
        start: State before the first step.
        last_state: State after the last step.
        states: State after each step if a term needs the states, otherwise empty.
        find_last_action: Returns the action executed last, (batch, action), NaN where unknown; None where no plan came
            before.
        generator: Random stream of a model that samples; None for other models.
    """

    model: Any
    batch: int
    num_particles: int
    actions: Tensor
    rewards: Tensor
    weights: Tensor
    start: State
    last_state: State
    states: tuple[State, ...]
    find_last_action: Callable[[], Tensor] | None = None
    generator: torch.Generator | None = None

    @property
    def last_action(self) -> Tensor:
        """The action executed before the first step, (rows, action); NaN where it is unknown."""
        first = self.actions[:, 0]
        if self.find_last_action is None:
            return torch.full_like(first, torch.nan)
        last = self.find_last_action().to(first)
        return last.repeat_interleave(len(first) // len(last), dim=0)


@dataclass(frozen=True)
class Objective:
    """A term or a composition of terms, `objective(rollout) -> (rows,)`, which a search maximises.

    Attributes:
        function: Computes the term from a rollout.
        needs_states: Whether the term reads the states between start and end; a model's `rollout` does not return them.
        num_particles: Number of rollouts of each candidate that the term needs.
        needs: Methods that the model must have.
        view: View of the model for a search for this objective alone, see `conditioned`; None for a sum of terms.
        max_change: Largest change of an action per step, one number or one per dimension, that a search holds for every
            candidate, see `rate_limit`; None for other terms.
    """

    function: Term
    needs_states: bool = False
    num_particles: int = 1
    needs: tuple[str, ...] = ()
    view: View | None = None
    max_change: tuple[float, ...] | None = None

    def __call__(self, rollout: Rollout) -> Tensor:
        """Returns the term of each row, (rows,)."""
        return self.function(rollout)

    def check(self, model: Model) -> None:
        """Refuses a model without a method that this objective needs.

        Raises:
            ValueError: The model lacks a method.
        """
        for method in self.needs:
            require(model, method, "this objective")

    def __add__(self, other: Term | float) -> Objective:
        return _compose(operator.add, self, other)

    def __sub__(self, other: Term | float) -> Objective:
        return _compose(operator.sub, self, other)

    def __rsub__(self, other: Term | float) -> Objective:
        return -self + other

    def __truediv__(self, other: float) -> Objective:
        return _compose(operator.truediv, self, other)

    def __mul__(self, other: Term | float) -> Objective:
        return _compose(operator.mul, self, other)

    def __neg__(self) -> Objective:
        return _compose(operator.mul, self, -1.0)

    def __radd__(self, other: Term | float) -> Objective:
        return self + other

    def __rmul__(self, other: Term | float) -> Objective:
        return self * other


def as_objective(term: Term) -> Objective:
    """Returns the term as an objective; a plain function is assumed to read the states of the rollout."""
    return term if isinstance(term, Objective) else Objective(term, needs_states=True)


def check_constraints(constraints: Any) -> None:
    """Refuses constraints that are no sequence of functions, such as a single function.

    Raises:
        TypeError: The constraints are something else.
    """
    if not isinstance(constraints, Sequence) or not all(map(callable, constraints)):
        got = "one function" if callable(constraints) else shown(constraints)
        raise TypeError(f"constraints must be a sequence of functions, such as [rate_limit(0.1)], got {got}")


def name_term(term: Term) -> str:
    """Returns the names of the functions of a term, without the numbers and tensors that they were given."""
    if isinstance(term, Objective):
        return name_term(term.function)
    if isinstance(term, partial):
        inner = [name_term(argument) for argument in term.args if callable(argument)]
        return f"{name_term(term.func)}({', '.join(inner)})"
    return getattr(term, "__qualname__", type(term).__qualname__)


def learned_return() -> Objective:
    """Returns the objective: predicted reward of every step, discounted and summed."""
    return Objective(_rewards)


def terminal_value() -> Objective:
    """Returns the objective: the model's value of the last state, discounted."""
    return Objective(_last_value, needs=("value",))


def goal_term(
    goal: Tensor,
    *,
    metric: str = "mse",
    over: str = "last",
    select: Callable[[State], Tensor] | None = None,
) -> Objective:
    """Returns the objective: minus the distance of imagined states to a goal, so 0 at the goal.

    Args:
        goal: Features of the goal, (feature,) for all environments or (batch, feature) for one each.
        metric: `mse` (mean squared error over features) or `cosine` (1 - cosine similarity).
        over: Distance of the `last` state, `sum` over all states, or `min`, the distance of the closest state.
        select: `select(state) -> (rows, feature)` returns the features to compare; None for states that are tensors.

    Raises:
        ValueError: `metric` or `over` has another value, or the goal is no tensor or has another rank.
    """
    if metric not in ("mse", "cosine") or over not in ("last", "sum", "min"):
        raise ValueError(f"metric must be mse or cosine and over last, sum or min, got {metric!r} and {over!r}")
    if not isinstance(goal, Tensor) or goal.ndim not in (1, 2):
        got = tuple(goal.shape) if isinstance(goal, Tensor) else type(goal).__name__
        raise ValueError(f"a goal is a tensor of shape (feature,) or (batch, feature), got {got}")

    return Objective(partial(_closeness, goal, metric, over, select), needs_states=over != "last")


def action_penalty() -> Objective:
    """Returns the objective: minus the squared actions, summed over steps and dimensions."""
    return Objective(_action_size)


def smoothness_penalty() -> Objective:
    """Returns the objective: minus the squared change of the action per step, summed over steps and dimensions.

    The change from the action executed last to the first action of the plan counts too, where the former is known: from
    the previous plan, or from the argument `last_action` of `plan`.
    """
    return Objective(_action_changes)


def rate_limit(
    per_step: float | Sequence[float] | None = None,
    *,
    per_second: float | Sequence[float] | None = None,
    step_seconds: float | None = None,
) -> Objective:
    """Returns the constraint that no action changes faster than a limit, from the action executed last on.

    `CEMPlanner` holds this constraint by construction: it limits the changes of every candidate. The bounds of the
    actions and the values of discrete actions prevail over the limit.

    Args:
        per_step: Largest change from one step to the next, in action units, one number or one per dimension.
        per_second: Largest change per second, one number or one per dimension.
        step_seconds: Duration of a model step in seconds, for `per_second`.

    Raises:
        ValueError: No limit is given, a limit is not above 0, the limits are for different numbers of dimensions, or
            one of `per_second` and `step_seconds` is missing.
    """
    if (per_second is None) != (step_seconds is None):
        raise ValueError("a rate limit per second needs both per_second and step_seconds")
    limits = []
    if per_step is not None:
        limits.append(torch.as_tensor(per_step, dtype=torch.float64, device="cpu"))
    if per_second is not None and step_seconds is not None:
        limits.append(torch.as_tensor(per_second, dtype=torch.float64, device="cpu") * step_seconds)
    if not limits or any(limit.ndim > 1 or limit.numel() == 0 or not bool((limit > 0).all()) for limit in limits):
        raise ValueError(f"a rate limit must be above 0, got per_step {per_step} and per_second {per_second}")
    sizes = {len(limit) for limit in limits if limit.ndim == 1} - {1}
    if len(sizes) > 1:
        raise ValueError(f"per_step and per_second are for different numbers of dimensions: {sorted(sizes)}")
    numbers = tuple(torch.atleast_1d(torch.minimum(limits[0], limits[-1])).tolist())
    return Objective(partial(_excess_change, numbers), max_change=numbers)


def uncertainty_penalty() -> Objective:
    """Returns the objective: minus the model's uncertainty of every step, discounted and summed."""
    return Objective(_uncertainty, needs_states=True, needs=("uncertainty",))


def risk(objective: Term, *, measure: str = "cvar", num_particles: int = 8, worst_share: float = 0.25) -> Objective:
    """Returns an objective with a risk measure over several rollouts of each candidate.

    The rollouts of a candidate differ if the model has `particles(state, num)`, which returns several versions of each
    state (members of an ensemble, samples of a belief), or if a step of the model samples. A constraint needs no risk
    measure, because its violation is the largest over the rollouts.

    Args:
        objective: Objective of one rollout.
        measure: `mean`, `worst`, or `cvar` (conditional value at risk): the mean of the worst share.
        num_particles: Number of rollouts per candidate.
        worst_share: Share of the rollouts that `cvar` averages, in (0, 1].

    Raises:
        ValueError: An argument is not allowed.
    """
    if measure not in ("mean", "worst", "cvar"):
        raise ValueError(f"measure must be mean, worst or cvar, got {measure!r}")
    if num_particles % 1 or num_particles < 1 or not 0.0 < worst_share <= 1.0:
        given = f"got {num_particles} and {worst_share}"
        raise ValueError(f"num_particles must be a whole number from 1 on and worst_share lie in (0, 1], {given}")
    inner, share = as_objective(objective), {"mean": 1.0, "worst": 0.0, "cvar": worst_share}[measure]
    return Objective(partial(_worst, inner, share), inner.needs_states, num_particles, inner.needs)


def at_every_state(function: Callable[[State], Tensor]) -> Objective:
    """Returns the constraint that `function(state) -> (rows,)` is at most 0 in every imagined state.

    The violation is the positive part of the function, summed over the steps.
    """
    return Objective(partial(_excess, function), needs_states=True)


def conditioned(view: View) -> Objective:
    """Returns the objective of a learned goal: the goal's reward, and its value of the last state.

    A goal-conditioned model has a reward, a value and a policy for each goal of a family. A view of this model is a
    model with the reward, the value and the policy of one goal. A search for `conditioned(view)` alone runs in the
    view: the goal's policy makes proposals, and plans have `horizon` steps. In a sum, `conditioned(view)` is scored in
    rollouts of the model, as every other term is.

    Args:
        view: `view(model)` returns a model with the same states and steps, but with the reward, the `value` and, for
            proposals, the `policy` of the goal.
    """
    return Objective(partial(_conditioned_return, view), needs_states=True, view=view)


def apply_view(model: Model, objective: Term | None) -> tuple[Model, Term | None]:
    """Returns the model to search in and the objective to search for.

    For a learned goal alone, the model is the view of this goal, and the objective is None: the view's own return.
    """
    view = objective.view if isinstance(objective, Objective) else None
    if view is None:
        return model, objective
    return (model.shown_as(view) if supports(model, "shown_as") else view(model)), None  # type: ignore[attr-defined]


def predicted_return(model: Model, use_value: bool | None) -> Objective:
    """Returns the default objective: the reward, plus the terminal value if `use_value`.

    Args:
        model: The model of the search.
        use_value: Whether the value is added; None adds it if the model has one.

    Raises:
        ValueError: `use_value` is true and the model has no value.
    """
    if use_value is None:
        use_value = supports(model, "value")
    if use_value:
        require(model, "value", "terminal_value=True")
    return learned_return() + terminal_value() if use_value else learned_return()


def _compose(operation: Callable[[Any, Any], Any], left: Objective, right: Term | float) -> Objective:
    if not callable(right):
        function = partial(_combine_with_number, operation, left, float(right))
        return Objective(function, left.needs_states, left.num_particles, left.needs)
    other = as_objective(right)
    particles = {left.num_particles, other.num_particles} - {1}
    if len(particles) > 1:
        raise ValueError(f"terms of one objective must agree on num_particles, got {sorted(particles)}")
    return Objective(
        partial(_combine_terms, operation, left, other),
        left.needs_states or other.needs_states,
        max(left.num_particles, other.num_particles),
        (*left.needs, *other.needs),
    )


def _combine_with_number(operation: Callable[[Any, Any], Any], left: Term, right: float, rollout: Rollout) -> Tensor:
    result: Tensor = operation(left(rollout), right)
    return result


def _combine_terms(operation: Callable[[Any, Any], Any], left: Term, right: Term, rollout: Rollout) -> Tensor:
    result: Tensor = operation(left(rollout), right(rollout))
    return result


def _rewards(rollout: Rollout) -> Tensor:
    return (rollout.rewards * rollout.weights[..., :-1]).sum(dim=1)


def _last_value(rollout: Rollout) -> Tensor:
    value = rollout.model.value(rollout.last_state)
    check_shape("value()", value, rollout.actions.shape[:1])
    weighted: Tensor = rollout.weights[..., -1] * value.to(rollout.rewards.dtype)
    return weighted


def _closeness(
    goal: Tensor, metric: str, over: str, select: Callable[[State], Tensor] | None, rollout: Rollout
) -> Tensor:
    if over == "last":
        return -_distance(goal, metric, select, rollout, rollout.last_state)
    distances = torch.stack([_distance(goal, metric, select, rollout, state) for state in rollout.states])
    return -(distances.sum(dim=0) if over == "sum" else distances.amin(dim=0))


def _distance(
    goal: Tensor, metric: str, select: Callable[[State], Tensor] | None, rollout: Rollout, state: State
) -> Tensor:
    features = state if select is None else select(state)
    if not isinstance(features, Tensor) or features.ndim != 2:
        got = f"shape {tuple(features.shape)}" if isinstance(features, Tensor) else type(features).__name__
        raise ValueError(f"goal_term() compares features (rows, feature), which select returns, got {got}")
    target = goal.to(features)
    check_shape("the goal", goal, (rollout.batch, features.shape[-1])[-goal.ndim :])
    if goal.ndim == 2:
        target = repeat(target, "batch feature -> (batch num) feature", num=len(features) // rollout.batch)
    if metric == "mse":
        return (features - target).square().mean(dim=-1)
    return 1 - functional.cosine_similarity(features, target.expand_as(features), dim=-1)


def _action_size(rollout: Rollout) -> Tensor:
    return -rollout.actions.square().sum(dim=(1, 2))


def _action_changes(rollout: Rollout) -> Tensor:
    first = _first_change(rollout).square().sum(dim=1)
    return -rollout.actions.diff(dim=1).square().sum(dim=(1, 2)) - first


def _excess_change(limit: tuple[float, ...], rollout: Rollout) -> Tensor:
    largest = rollout.actions.new_tensor(limit)
    later = (rollout.actions.diff(dim=1).abs() - largest).clamp_min(0.0).sum(dim=(1, 2))
    return later + (_first_change(rollout).abs() - largest).clamp_min(0.0).sum(dim=1)


def _first_change(rollout: Rollout) -> Tensor:
    """Returns the change from the action executed last to the first action, 0 where the former is unknown."""
    last = rollout.last_action
    return torch.where(torch.isnan(last), 0.0, rollout.actions[:, 0] - last)


def _uncertainty(rollout: Rollout) -> Tensor:
    before = (rollout.start, *rollout.states[:-1])
    pairs = zip(before, rollout.actions.unbind(dim=1), strict=True)
    uncertainties = [rollout.model.uncertainty(state, action) for state, action in pairs]
    return -(rollout.weights[..., :-1] * _stack_steps("uncertainty()", uncertainties, rollout)).sum(dim=1)


def _worst(inner: Term, share: float, rollout: Rollout) -> Tensor:
    num_worst = max(1, round(share * rollout.num_particles))  # a model may have more particles than the term needs
    values = inner(rollout)
    check_shape("the objective of risk()", values, rollout.actions.shape[:1])
    values = rearrange(values, "(row particle) -> row particle", particle=rollout.num_particles)
    worst = torch.topk(values, num_worst, dim=1, largest=False).values.mean(dim=1)
    # NaN sorts as the largest number, so `topk` never counts a NaN particle among the worst.
    worst = worst.masked_fill(values.isnan().any(dim=1), float("nan"))
    return repeat(worst, "row -> (row particle)", particle=rollout.num_particles)


def _conditioned_return(view: View, rollout: Rollout) -> Tensor:
    viewed = view(rollout.model)
    require(viewed, "value", "a learned goal")
    before = (rollout.start, *rollout.states[:-1])
    pairs = zip(before, rollout.actions.unbind(1), strict=True)
    steps = [call_with(viewed.step, rollout.generator, state, action) for state, action in pairs]
    rewards = torch.stack([reward for _, reward in steps], dim=1)
    rewards = rewards.to(rollout.rewards.dtype)
    value: Tensor = viewed.value(rollout.last_state).to(rewards.dtype)  # type: ignore[attr-defined]
    return (rewards * rollout.weights[..., :-1]).sum(dim=1) + rollout.weights[..., -1] * value


def _excess(function: Callable[[State], Tensor], rollout: Rollout) -> Tensor:
    values = [function(state) for state in rollout.states]
    excess = _stack_steps("the function of at_every_state()", values, rollout).clamp_min(0.0)
    return excess.sum(dim=1)


def _stack_steps(name: str, values: Sequence[Any], rollout: Rollout) -> Tensor:
    """Returns the values of all steps, (rows, step); `check_shape` refuses a step that is not (rows,)."""
    for value in values:
        check_shape(name, value, rollout.actions.shape[:1])
    return torch.stack(list(values), dim=1)
