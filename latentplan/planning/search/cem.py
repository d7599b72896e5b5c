"""The cross-entropy method over action sequences as a planner, and its relatives iCEM and MPPI."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import torch

from latentplan.config.planner import WIDEST_STD, SearchOptions, check_whole
from latentplan.planning.model import Bound, Model, State, per_dimension
from latentplan.planning.objectives import Constraint, Term
from latentplan.planning.plan import Plan
from latentplan.planning.search.deadline import Pace
from latentplan.planning.search.loop import Problem, Search
from latentplan.planning.search.sampling import Generators


@dataclass(frozen=True, kw_only=True, eq=False)
class CEMPlanner(SearchOptions):
    """Searches action sequences by refitting a Gaussian to its best samples, inside a model.

    All options of `SearchOptions` are arguments too. A planner keeps no plan: the previous plan is passed to `plan`.
    A planner keeps only the durations of its searches, for deadlines.

    Attributes:
        action_dim: Numbers in an action.
        action_low: Lowest action, one number or one per dimension.
        action_high: Highest action, one number or one per dimension.
        init_std: See `SearchOptions`; here also one number per action dimension.
        discount: Discount per model step, in (0, 1].
        clock: Returns the time in seconds; None takes `time.perf_counter`.
    """

    action_dim: int
    action_low: Bound = -1.0
    action_high: Bound = 1.0
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
    ) -> Plan:
        """Searches the best action sequence from each state.

        The `info` of the plan has these entries:

        - `elite_return`: mean return of the elites after each refit, (batch, iteration);
        - `std`: mean standard deviation of the samples after each refit, (batch, iteration);
        - `iterations`: number of refits, (batch,);
        - `num_nonfinite`: number of candidates whose return was not finite, (batch,);
        - `is_fallback`: whether no candidate had a finite return or no iteration fitted the deadline, so that the
          actions are the tail of the previous plan, zeros, or the policy's, (batch,);
        - `is_policy`: whether no iteration fitted the deadline and the actions are the policy's, (batch,); false
          unless the policy makes proposals, and false with constraints or an objective for which the policy was not
          trained;
        - `violation`: violation of the chosen sequence, only with constraints, (batch,);
        - `stopped`: the reason the search ended, "iterations" or "deadline".

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

        Returns:
            The plan; `Plan` describes the diagnostics in its `info`.

        Raises:
            ValueError: The model lacks a method that an option needs, a method of the model returned a wrong shape, or
                the deadline is negative.
        """
        clock = self.clock or time.perf_counter
        started = clock()
        deadline_ms = self.deadline_ms if deadline_ms is None else deadline_ms
        if deadline_ms is not None and not deadline_ms >= 0.0:
            raise ValueError(f"deadline_ms must be at least 0, got {deadline_ms}")
        # In inference mode the plan could not be a training target, and gradient steps would fail.
        with torch.inference_mode(False), torch.no_grad():
            search = Search(self, self._problem(model, state, objective, constraints), generator)
            seconds = None if deadline_ms is None else deadline_ms / 1000
            return search.run(previous, search.budget(self.pace, clock, started, seconds))

    def _problem(
        self, model: Model, state: State, objective: Term | None, constraints: Sequence[Constraint]
    ) -> Problem:
        low, high = (self._per_dimension(name) for name in ("action_low", "action_high"))
        init_std = None if self.init_std is None else self._per_dimension("init_std")
        return Problem(model, state, objective, constraints, low, high, init_std, self.discount)

    def _per_dimension(self, name: str) -> torch.Tensor:
        return per_dimension(getattr(self, name), self.action_dim, name)


def icem_planner(**settings: Any) -> CEMPlanner:
    """Returns the improved CEM of Pinneri et al. 2020: coloured noise, kept and shifted elites, best candidate.

    Args:
        **settings: Arguments of `CEMPlanner`; they replace `noise_beta` 2, `keep_elite_fraction` 0.3 and `final`
            "best".
    """
    own: dict[str, Any] = {"noise_beta": 2.0, "keep_elite_fraction": 0.3, "final": "best"}
    return CEMPlanner(**own | settings)


def mppi_planner(**settings: Any) -> CEMPlanner:
    """Returns MPPI (Williams et al. 2017): one refit to all candidates, weighted by exp(return / temperature).

    Args:
        **settings: Arguments of `CEMPlanner`; they replace `temperature` 1, `smoothing` 1, `num_iterations` 1,
            `adapt_std` False, and `num_elites`, which is all of `num_samples`. A warm start has at most
            `num_iterations` refits.
    """
    num_samples = settings.get("num_samples", SearchOptions.num_samples)
    own: dict[str, Any] = {"num_elites": num_samples, "num_iterations": 1}
    own |= {"smoothing": 1.0, "temperature": 1.0, "adapt_std": False}
    merged = own | settings
    if (merged.get("warm_start_iterations") or 1) > merged["num_iterations"]:
        merged["warm_start_iterations"] = merged["num_iterations"]
    return CEMPlanner(**merged)


def _check_problem(planner: CEMPlanner) -> None:
    check_whole(planner, 1, "action_dim")
    if not 0.0 < planner.discount <= 1.0:
        raise ValueError(f"discount must lie in (0, 1], got {planner.discount}")
    low = per_dimension(planner.action_low, planner.action_dim, "action_low")
    high = per_dimension(planner.action_high, planner.action_dim, "action_high")
    if not bool((low < high).all()):
        raise ValueError(f"action_low {low.tolist()} must lie below action_high {high.tolist()}")
    if planner.init_std is not None:
        init_std = per_dimension(planner.init_std, planner.action_dim, "init_std")
        if not bool(((init_std >= 0) & (init_std <= WIDEST_STD)).all()):
            raise ValueError(f"init_std must lie in [0, {WIDEST_STD:g}], got {init_std.tolist()}")
