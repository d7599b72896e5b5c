"""The cross-entropy method over action sequences as a planner, and its relatives iCEM and MPPI."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import torch

from latentplan.config.checks import shown
from latentplan.config.planner import WIDEST_STD, SearchOptions, check_whole
from latentplan.planning.model import Bound, Model, State, count_rows, per_dimension, per_step, state_device
from latentplan.planning.objectives import Constraint, Term
from latentplan.planning.plan import Iteration, Plan
from latentplan.planning.search.choices import read_choices
from latentplan.planning.search.deadline import Pace
from latentplan.planning.search.loop import Search
from latentplan.planning.search.problem import Problem, View
from latentplan.planning.search.purity import FirstSearches
from latentplan.planning.search.sampling import Generators
from latentplan.planning.search.space import read_bounds

# Options for which a planner has a value of its own.
CEM_GRADIENT: dict[str, Any] = {"gradient_steps": 5}
ICEM: dict[str, Any] = {"noise_beta": 2.0, "white_noise_share": 0.0, "keep_elite_fraction": 0.5, "final": "best"}
MPPI: dict[str, Any] = {
    "num_iterations": 1,
    "smoothing": 1.0,
    "temperature": 0.1,
    "adapt_std": False,
    "keep_elite_fraction": 0.0,
    "noise_beta": 2.0,
    "white_noise_share": 0.5,
    "final": "better",
}


@dataclass(frozen=True, kw_only=True, eq=False)
class CEMPlanner(SearchOptions):
    """Searches action sequences by refitting a Gaussian to its best samples, inside a model.

    All options of `SearchOptions` are arguments too. A planner keeps no plan: the previous plan is passed to `plan`.
    A planner keeps only the durations of its searches, for deadlines.

    Attributes:
        action_dim: Numbers in an action.
        action_low: Lowest action: one number, one per dimension, one per step (horizon, action), or (batch, horizon,
            action). The first step is the present one. Bounds lie in [-1e15, 1e15].
        action_high: Highest action, like `action_low`.
        action_choices: Discrete actions. A number n lets every dimension take the values 0 to n - 1, and a sequence
            lists the values. A mapping from dimensions to numbers or sequences makes the other dimensions continuous.
        init_mean: Mean of a search that starts without a previous plan, and end of a shifted plan with the tail `zero`:
            a value like `action_low`, or a `Plan`; None takes the middle between `action_low` and `action_high`.
        init_std: See `SearchOptions`; here also one number per action dimension.
        discount: Discount per model step, in (0, 1].
        clock: Returns the time in seconds; None takes `time.perf_counter`.
    """

    action_dim: int
    action_low: Bound = -1.0
    action_high: Bound = 1.0
    action_choices: Any = None
    init_mean: Bound | Plan | None = None
    init_std: Bound | None = None  # type: ignore[assignment]  # wider than the setting, which is one number
    discount: float = 1.0
    clock: Callable[[], float] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_problem(self)

    @classmethod
    def from_config(
        cls,
        config: SearchOptions,
        action_dim: int,
        discount: float,
        *,
        action_low: Bound = -1.0,
        action_high: Bound = 1.0,
    ) -> CEMPlanner:
        """Returns the planner with the options of a configuration, for actions of `action_dim` numbers."""
        options: dict[str, Any] = {option.name: getattr(config, option.name) for option in fields(SearchOptions)}
        return cls(action_dim=action_dim, discount=discount, action_low=action_low, action_high=action_high, **options)

    @cached_property
    def choices(self) -> dict[int, tuple[float, ...]]:
        """By discrete dimension, the values that an action takes there; empty for continuous actions."""
        return read_choices(self.action_choices, self.action_dim)

    @cached_property
    def bounds(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Lowest and highest action, each (1 or batch, 1 or horizon, action), float64."""
        return self._read_bounds(self.action_low, self.action_high)

    @cached_property
    def first_searches(self) -> FirstSearches:
        """The models that this planner has searched in; the first candidates in each are watched."""
        return FirstSearches()

    @cached_property
    def pace(self) -> Pace:
        """Durations of earlier searches, from which a search with a deadline predicts the parts that fit."""
        return Pace()

    def plan(
        self,
        model: Model,
        state: State,
        previous: Plan | None = None,
        *,
        objective: Term | None = None,
        constraints: Sequence[Constraint] = (),
        generator: Generators = None,
        deadline_ms: float | None = None,
        last_action: Any = None,
        bounds: tuple[Bound, Bound] | None = None,
        keep: str | None = None,
        callback: Callable[[Iteration], Any] | None = None,
    ) -> Plan:
        """Searches the best action sequence from each state.

        Args:
            model: The model in which action sequences are imagined; see `latentplan.planning.model`.
            state: Start of the plans, rows (batch,).
            previous: The previous plan, for a warm start.
            objective: Maximised, `objective(rollout) -> (rows,)`; None is the discounted reward, plus the value of the
                last state if the option `terminal_value` says so.
            constraints: Each returns the violation of every rollout, (rows,), 0 where the constraint is satisfied.
            generator: One generator for all environments, or one per environment; None takes torch's default. An
                environment's plan does not depend on the others.
            deadline_ms: Milliseconds that this call may take; None takes the planner's own limit, infinity lifts it. A
                part of the search starts only if earlier durations of such parts predict that it ends in time.
            last_action: The action executed last, (batch, action), for `smoothness_penalty` and `rate_limit`; None
                takes it from the previous plan.
            bounds: Lowest and highest action of this call, in place of `action_low` and `action_high`.
            keep: `candidates` keeps the candidates of every iteration in `Plan.candidates`, with returns and
                feasibility; `states` keeps their imagined states too; None keeps nothing.
            callback: `callback(iteration)` is called after every iteration, with the same fields.

        Returns:
            The plan; `Plan` describes the diagnostics in its `info`.

        Raises:
            TypeError: An argument, or what the user's functions returned, has a wrong type.
            ValueError: The model lacks a method that an option needs, a method of the model returned a wrong shape,
                the bounds are no pair or do not fit each other, or the deadline is negative.
        """
        clock = self.clock or time.perf_counter
        started = clock()
        deadline_ms = self.deadline_ms if deadline_ms is None else deadline_ms
        if deadline_ms is not None and not deadline_ms >= 0.0:
            raise ValueError(f"deadline_ms must be at least 0, got {deadline_ms}")
        if keep not in (None, "candidates", "states"):
            raise ValueError(f"keep must be candidates, states or None, got {keep!r}")
        # In inference mode the plan could not be a training target, and gradient steps would fail.
        with torch.inference_mode(False), torch.no_grad():
            low, high = self.bounds if bounds is None else self._read_bounds(*_as_pair(bounds))
            last = None if last_action is None else _place_beside(state, last_action)
            start, spread, discount = self._init_mean, self._init_std, self.discount
            goals, seen = (objective, constraints), self.first_searches
            problem = Problem(model, state, *goals, low, high, start, spread, discount, self.choices, last, seen)
            search = Search(self, problem, generator, previous, View(keep, callback))
            seconds = None if deadline_ms is None else deadline_ms / 1000
            return search.run(search.budget(self.pace, clock, started, seconds))

    @cached_property
    def _init_mean(self) -> torch.Tensor | None:
        if self.init_mean is None:
            return None
        if not isinstance(self.init_mean, Plan):
            return per_step(self.init_mean, self.action_dim, "init_mean")
        actions = self.init_mean.actions.double()
        missing = max(self.horizon, self.goal_horizon or 0) - actions.shape[1]
        return torch.cat([actions, actions[:, -1:].expand(-1, max(0, missing), -1)], dim=1)

    @cached_property
    def _init_std(self) -> torch.Tensor | None:
        return None if self.init_std is None else per_step(self.init_std, self.action_dim, "init_std")

    def _read_bounds(self, low: Bound, high: Bound) -> tuple[torch.Tensor, torch.Tensor]:
        lowest, highest = read_bounds(low, high, self.action_dim, self.choices)
        sizes = zip(lowest.shape, highest.shape, strict=True)
        if any(first != second and 1 not in (first, second) for first, second in sizes):
            shapes = f"{tuple(lowest.shape)} and {tuple(highest.shape)}"
            raise ValueError(f"action_low and action_high must fit each other, (batch, horizon, action), got {shapes}")
        if not bool((torch.maximum(-lowest, highest) <= WIDEST_STD).all()):
            raise ValueError(f"action_low and action_high must lie in [-{WIDEST_STD:g}, {WIDEST_STD:g}]")
        if not bool((lowest < highest).all()):
            given = f"action_low {lowest.squeeze().tolist()} must lie below action_high {highest.squeeze().tolist()}"
            raise ValueError(given)
        return lowest, highest


def icem_planner(**settings: Any) -> CEMPlanner:
    """Returns the improved CEM of Pinneri et al. 2020: coloured noise, kept and shifted elites, best candidate.

    Args:
        **settings: Arguments of `CEMPlanner`; they replace `noise_beta` 2, `white_noise_share` 0, `keep_elite_fraction`
            0.5 and `final` "best".
    """
    return CEMPlanner(**ICEM | settings)


def mppi_planner(**settings: Any) -> CEMPlanner:
    """Returns MPPI (Williams et al. 2017): refits to all candidates, weighted by exp(return / (temperature * spread)).

    The spread is the standard deviation of the candidates' returns, so one temperature serves returns of any scale.

    Args:
        **settings: Arguments of `CEMPlanner`; they replace `temperature` 0.1, `smoothing` 1, `num_iterations` 1,
            `adapt_std` False, `keep_elite_fraction` 0, `noise_beta` 2, `white_noise_share` 0.5, `final` "better",
            `num_elites`, which is all of `num_samples`, and `warm_start_iterations`, which is `num_iterations`.
    """
    merged = MPPI | settings
    merged.setdefault("num_elites", merged.get("num_samples", SearchOptions.num_samples))
    if merged.get("warm_start_iterations") is None:
        merged["warm_start_iterations"] = merged["num_iterations"]
    return CEMPlanner(**merged)


def cem_gradient_planner(**settings: Any) -> CEMPlanner:
    """Returns the cross-entropy method, and after it gradient ascent on the chosen sequence, in a differentiable model.

    The ascent pauses for some searches where it does not raise the return by a tenth of the elites' standard deviation.

    Args:
        **settings: Arguments of `CEMPlanner`; they replace `gradient_steps` 5.
    """
    return CEMPlanner(**CEM_GRADIENT | settings)


# By planner, the options for which it has a value of its own.
OWN_OPTIONS: dict[Callable[..., Any], set[str]] = {
    CEMPlanner: set(),
    cem_gradient_planner: set(CEM_GRADIENT),
    icem_planner: set(ICEM),
    mppi_planner: {*MPPI, "num_elites", "warm_start_iterations"},
}


def _place_beside(state: State, action: Any) -> torch.Tensor:
    count_rows(state)  # refuses what is no state
    return torch.as_tensor(action, device=state_device(state))


def _as_pair(bounds: Any) -> tuple[Bound, Bound]:
    """Returns the lowest and the highest action of a call.

    Raises:
        ValueError: The bounds are no pair.
    """
    try:
        low, high = bounds
    except (TypeError, ValueError):
        raise ValueError(f"bounds must be a pair (lowest action, highest action), got {shown(bounds)}") from None
    return low, high


def _check_problem(planner: CEMPlanner) -> None:
    check_whole(planner, 1, "action_dim")
    if not 0.0 < planner.discount <= 1.0:
        raise ValueError(f"discount must lie in (0, 1], got {planner.discount}")
    _ = planner.bounds  # refuses bounds that do not fit
    if isinstance(planner.init_mean, Plan) and planner.init_mean.actions.shape[-1] != planner.action_dim:
        dim = planner.init_mean.actions.shape[-1]
        raise ValueError(f"init_mean is a plan of {dim} numbers per action, action_dim is {planner.action_dim}")
    if planner.init_mean is not None and not isinstance(planner.init_mean, Plan):
        per_step(planner.init_mean, planner.action_dim, "init_mean")
    if planner.init_std is not None:
        init_std = per_dimension(planner.init_std, planner.action_dim, "init_std")
        if not bool(((init_std >= 0) & (init_std <= WIDEST_STD)).all()):
            raise ValueError(f"init_std must lie in [0, {WIDEST_STD:g}], got {init_std.tolist()}")
