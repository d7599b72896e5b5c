"""The cross-entropy method over action sequences, as a planner."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from numbers import Integral
from typing import Any

import torch
from torch import Tensor

from latentplan.config import PlannerConfig
from latentplan.config.planner import STEEPEST_NOISE, WIDEST_STD
from latentplan.planning.model import Model, State, per_dimension
from latentplan.planning.objectives import Constraint, Term
from latentplan.planning.plan import Plan
from latentplan.planning.search.deadline import Pace
from latentplan.planning.search.loop import Search
from latentplan.planning.search.sampling import Generators

Bound = float | Sequence[float] | Tensor
_CHOICES = {
    "start": ("shifted", "policy", "both"),
    "final": ("mean", "best", "better"),
    "tail": ("zero", "hold", "policy"),
    "warm_start_variance": ("reset", "keep", "inflate"),
}


@dataclass(frozen=True, kw_only=True, eq=False)
class CEMPlanner:
    """Searches action sequences by refitting a Gaussian to its best samples, inside a model.

    A search keeps nothing but how long it took: the last plan is passed in, and every option is fixed at construction.

    Attributes:
        action_dim: Numbers in an action.
        horizon: Model steps that a plan looks ahead.
        goal_horizon: The same where `plan` is given an objective, which may know no value; None takes `horizon`.
        num_samples: Candidates per iteration, proposals included; those kept from earlier iterations come on top.
        num_elites: Best candidates that refit the search distribution.
        num_iterations: Refits of a cold start.
        warm_start_iterations: Refits when the last plan is handed on; None takes `num_iterations`.
        smoothing: Weight of the new statistics in the Polyak update of mean and variance, in (0, 1].
        action_low: Lowest action, one number or one per dimension.
        action_high: Highest action, one number or one per dimension.
        init_std: Standard deviation at the start of a search, in action units; None takes half the range.
        min_std: Floor of the sampling standard deviation, in action units.
        discount: Discount per model step, in (0, 1].
        num_policy_samples: Candidates proposed by the model's policy, its mode first; 0 leaves the policy out.
        warm_start: Whether a search starts from the shifted last plan.
        terminal_value: Whether the model's value completes the return; None does so when the model has one.
        use_continues: Whether the model's probability of going on discounts what follows.
        start: Centre of the search: `shifted` (the last plan), `policy` (its mode sequence) or `both` (half the
            candidates of the first iteration around each). Without policy samples it is `shifted`.
        tail: What fills the end of the shifted plan: `zero`, `hold` or `policy`.
        warm_start_variance: Variance of a warm start: `reset`, `keep`, or `inflate` (halfway between these).
        final: What is executed: the `mean` of the distribution, the `best` candidate, or the `better` of the mean and
            the policy's mode, by their predicted returns; where the policy has no say `better` is `mean`.
        noise_beta: Exponent of coloured sampling noise, 0 for white, at most 100; larger is smoother over the horizon.
        keep_elite_fraction: Share of the elites that stay candidates in the next iteration and, shifted, the next plan.
        stop_std: Stop early where the search distribution is narrower than this everywhere, in action units; 0 never.
        temperature: None weighs elites alike; a number weighs them by exp(return / temperature) as MPPI does.
        adapt_std: Whether the variance is refitted too.
        gradient_steps: Steps of gradient ascent on the chosen sequence; the model must be differentiable.
        gradient_step_size: Largest change of an action in the first of these steps, in action units.
        constraint_penalty: None ranks feasible candidates first; a number subtracts that much per unit of violation.
        deadline_ms: Milliseconds that a call of `plan` may take; None is as long as the search likes.
        clock: Gives the time in seconds; None takes `time.perf_counter`.
    """

    action_dim: int
    horizon: int
    goal_horizon: int | None = None
    num_samples: int = 256
    num_elites: int = 32
    num_iterations: int = 4
    warm_start_iterations: int | None = None
    smoothing: float = 0.9
    action_low: Bound = -1.0
    action_high: Bound = 1.0
    init_std: Bound | None = None
    min_std: float = 0.0
    discount: float = 1.0
    num_policy_samples: int = 0
    warm_start: bool = True
    terminal_value: bool | None = None
    use_continues: bool = False
    start: str = "shifted"
    tail: str = "zero"
    warm_start_variance: str = "reset"
    final: str = "mean"
    noise_beta: float = 0.0
    keep_elite_fraction: float = 0.0
    stop_std: float = 0.0
    temperature: float | None = None
    adapt_std: bool = True
    gradient_steps: int = 0
    gradient_step_size: float = 0.1
    constraint_penalty: float | None = None
    deadline_ms: float | None = None
    clock: Callable[[], float] | None = None

    def __post_init__(self) -> None:
        _validate(self)

    @cached_property
    def pace(self) -> Pace:
        """What the parts of earlier searches took, for deadlines; the one thing of a planner that changes."""
        return Pace()

    @property
    def num_kept(self) -> int:
        """Elites that stay candidates; at least one when any share is kept."""
        return 0 if self.keep_elite_fraction == 0 else max(1, round(self.keep_elite_fraction * self.num_elites))

    @classmethod
    def from_config(
        cls,
        config: PlannerConfig,
        action_dim: int,
        discount: float,
        *,
        action_low: Bound = -1.0,
        action_high: Bound = 1.0,
    ) -> CEMPlanner:
        """The planner that a configuration describes, for actions of `action_dim` numbers."""
        options: dict[str, Any] = {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}
        del options["surprise_limit"]  # an agent's: a planner sees no frames
        return cls(action_dim=action_dim, discount=discount, action_low=action_low, action_high=action_high, **options)

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

        Args:
            model: What imagines; see `latentplan.planning.model`.
            state: Where plans start, rows (batch,).
            previous: The last plan, for a warm start.
            objective: What is maximised, `objective(rollout) -> (rows,)`; None is the discounted reward, with the
                terminal value as set.
            constraints: What candidates must keep: each gives a violation `(rows,)`, 0 where it is kept.
            generator: One for all environments (each then sees the same noise), or a list of one per environment;
                None takes torch's default. A plan does not depend on which environments share the call.
            deadline_ms: What the call may take, from here on; None takes the planner's own, infinity lifts it. No
                iteration, and no gradient refinement, is started that is not expected to end in time, judged by
                those measured before at this problem size (see `Pace`).

        Returns:
            The plan. Its `info`: `elite_return` and `std` (batch, iteration), `iterations`, `num_nonfinite` and
            `is_fallback` (batch,) (nothing finite was found, or there was no time for one iteration, so the last
            plan's tail or zeros stand in), `is_policy` (batch,) (only time was short, so the policy stands in;
            proposals must be asked for, and nothing but the model's own return be wanted), `violation` (batch,) of the
            chosen sequence when there are constraints, and `stopped`, what ended the search: "iterations", "agreement"
            (of the elites: `stop_std`) or "deadline".

        Raises:
            ValueError: The model lacks what a setting asks for, something returned a wrong shape, or the deadline is
                negative.
        """
        started = (self.clock or time.perf_counter)()
        deadline_ms = self.deadline_ms if deadline_ms is None else deadline_ms
        if deadline_ms is not None and not deadline_ms >= 0.0:
            raise ValueError(f"deadline_ms must be at least 0, got {deadline_ms}")
        # Leaving inference mode keeps the plan usable as a training target, and lets gradient steps work.
        with torch.inference_mode(False), torch.no_grad():
            search = Search(self, model, state, objective, constraints, generator, started, deadline_ms)
            return search.run(previous)


def _validate(planner: CEMPlanner) -> None:
    for name in ("action_dim", "horizon", "num_samples", "num_elites", "num_iterations"):
        _check_whole(name, getattr(planner, name), 1)
    for name in ("warm_start_iterations", "goal_horizon"):
        if getattr(planner, name) is not None:
            _check_whole(name, getattr(planner, name), 1)
    for name in ("num_policy_samples", "gradient_steps"):
        _check_whole(name, getattr(planner, name), 0)
    if planner.num_elites > planner.num_samples:
        raise ValueError(f"num_elites ({planner.num_elites}) must not exceed num_samples ({planner.num_samples})")
    if planner.num_policy_samples >= planner.num_samples:
        raise ValueError(
            f"num_policy_samples ({planner.num_policy_samples}) must lie below num_samples ({planner.num_samples})"
        )
    for name, allowed in _CHOICES.items():
        if getattr(planner, name) not in allowed:
            raise ValueError(f"{name} must be one of {', '.join(allowed)}, got {getattr(planner, name)!r}")
    for name in ("smoothing", "discount"):
        if not 0.0 < getattr(planner, name) <= 1.0:
            raise ValueError(f"{name} must lie in (0, 1], got {getattr(planner, name)}")
    for name in ("stop_std", "constraint_penalty"):
        if not 0.0 <= (getattr(planner, name) or 0.0) < math.inf:
            raise ValueError(f"{name} must be finite and at least 0, got {getattr(planner, name)}")
    for name, most in (("min_std", WIDEST_STD), ("noise_beta", STEEPEST_NOISE)):
        if not 0.0 <= getattr(planner, name) <= most:
            raise ValueError(f"{name} must lie in [0, {most:g}], got {getattr(planner, name)}")
    if not 0.0 <= planner.keep_elite_fraction <= 1.0:
        raise ValueError(f"keep_elite_fraction must lie in [0, 1], got {planner.keep_elite_fraction}")
    for name in ("temperature", "gradient_step_size", "deadline_ms"):
        if getattr(planner, name) is not None and not getattr(planner, name) > 0.0:
            raise ValueError(f"{name} must be above 0, got {getattr(planner, name)}")
    _validate_bounds(planner)


def _check_whole(name: str, value: int, least: int) -> None:
    if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
        raise ValueError(f"{name} must be a whole number, at least {least}, got {value}")


def _validate_bounds(planner: CEMPlanner) -> None:
    low = per_dimension(planner.action_low, planner.action_dim, "action_low")
    high = per_dimension(planner.action_high, planner.action_dim, "action_high")
    if not bool((low < high).all()):
        raise ValueError(f"action_low {low.tolist()} must lie below action_high {high.tolist()}")
    if planner.init_std is not None:
        init_std = per_dimension(planner.init_std, planner.action_dim, "init_std")
        if not bool(((init_std >= 0) & (init_std <= WIDEST_STD)).all()):
            raise ValueError(f"init_std must lie in [0, {WIDEST_STD:g}], got {init_std.tolist()}")
