"""Options of the search over action sequences, and settings of an agent's planner.

The planning library builds on `SearchOptions`: one set of names, defaults and checks for every planner.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any

from latentplan.config.checks import above_zero, one_of, shown, within

WIDEST_STD = 1e15  # the square of this std, and sums of such squares, are finite in float32
STEEPEST_NOISE = 100.0  # far below this exponent all steps share one cosine; from 150 on powers overflow
NUM_POLICY_SAMPLES = 24
ELITE_SHARE = 0.125
METHODS = ("cem", "cem_gradient", "icem", "mppi")  # the names in `PLANNERS`, known without torch
TAKING_DEFAULT_ELITES = ("cem", "cem_gradient", "icem")  # planners without a number of elites of their own


@dataclass(frozen=True, kw_only=True)
class SearchOptions:
    """Options of a search over action sequences. `None` means that the search derives the value.

    Attributes:
        horizon: Model steps that a plan looks ahead.
        goal_horizon: Model steps that a plan for an objective other than the predicted return looks ahead; null takes
            `horizon`.
        num_samples: Candidate sequences per iteration, the policy's proposals included.
        num_elites: Best candidates that refit the search distribution; null takes an eighth of `num_samples`.
        num_iterations: Refits of a search that starts without a previous plan.
        warm_start_iterations: Refits of a search that starts from the previous plan; null takes half of
            `num_iterations`, rounded up.
        smoothing: Weight of the new statistics in the Polyak update of mean and variance, in (0, 1].
        init_std: Standard deviation at the start of a search, in action units; null takes a quarter of the action
            range, which is 0.5 for actions in [-1, 1].
        min_std: Floor of the sampling standard deviation, in action units; where `init_std` is null the floor is at
            most the std at the start.
        num_policy_samples: Candidates proposed by the model's policy, its mode first; 0 leaves the policy out; null
            takes 24 (at most a quarter of `num_samples`) where the model has a policy, else 0.
        warm_start: Whether a search starts from the shifted previous plan.
        terminal_value: Whether the value of the last imagined state completes the return; null does so where the model
            has a value.
        use_continues: Whether the predicted probability that the episode goes on discounts the later rewards.
        tail: How the end of the shifted previous plan is filled: `zero`, `hold` (the last action again) or `policy`.
        final: The sequence that is executed: the `mean` of the distribution, the `best` candidate, or the `better` of
            the mean and another sequence, by predicted return: the policy's own sequence, or the best candidate where
            the policy makes no proposals or constraints or an objective that it was not trained for are set.
        policy_margin: The policy's own sequence is executed unless the return that the plan is predicted to earn is
            higher by more than this share of the policy's, at least 0: a smaller gain is within the error of a learned
            value. No effect where the policy makes no proposals, or constraints or an objective that it was not trained
            for are set. null stands for 0 where `final` is `better`, else the plan is always executed.
        noise_beta: Exponent of coloured sampling noise, in [0, 100]; 0 is white, larger is smoother over the horizon.
        white_noise_share: Share of the samples whose noise is white although `noise_beta` is above 0, in [0, 1]. Where
            both kinds exist, the smooth ones explore further than `init_std`, and the white ones less far.
        overshoot: How far candidates and mean of the search may leave the bounds, in action ranges, in [0, 10]; their
            actions are then at the bounds. Helps where the best actions lie on the bounds.
        keep_elite_fraction: Share of the elites that stay candidates in the next iteration and plan, in [0, 1].
        temperature: Elites are weighted by exp(return / (temperature * spread)) as in MPPI, where the spread is the
            standard deviation of their returns; null weights all elites alike.
        adapt_std: Whether the variance is refitted too.
        action_spline: A search over the knots of a spline instead of every action: `zero` (each knot is held), `linear`
            or `cubic`; null searches over the actions.
        num_knots: Knots of the spline, at most `horizon`; null takes a third of `horizon`, rounded up, at least 2.
        gradient_steps: Steps of gradient ascent on the chosen sequence; the model must be differentiable.
        gradient_step_size: Largest change of an action in the first gradient step, in action units; null takes a
            twentieth of the action range, which is 0.1 for actions in [-1, 1].
        constraint_penalty: Return that is subtracted per unit of violation; null ranks feasible candidates first.
        deadline_ms: Milliseconds that a search may take; null sets no limit.

    Raises:
        ValueError: An option has a value that is not allowed; the message names the option.
    """

    horizon: int = 8
    goal_horizon: int | None = None
    num_samples: int = 128
    num_elites: int | None = None
    num_iterations: int = 4
    warm_start_iterations: int | None = None
    smoothing: float = 0.9
    init_std: float | None = None
    min_std: float = 0.05
    num_policy_samples: int | None = None
    warm_start: bool = True
    terminal_value: bool | None = None
    use_continues: bool = False
    tail: str = "zero"
    final: str = "better"
    policy_margin: float | None = None
    noise_beta: float = 2.0
    white_noise_share: float = 0.5
    overshoot: float = 0.0
    keep_elite_fraction: float = 0.5
    temperature: float | None = None
    adapt_std: bool = True
    action_spline: str | None = None
    num_knots: int | None = None
    gradient_steps: int = 0
    gradient_step_size: float | None = None
    constraint_penalty: float | None = None
    deadline_ms: float | None = None

    def __post_init__(self) -> None:
        check_whole(self, 1, "horizon", "goal_horizon", "num_samples", "num_elites", "num_iterations")
        check_whole(self, 1, "warm_start_iterations", "num_knots")
        check_whole(self, 0, "num_policy_samples", "gradient_steps")
        above_zero(self, "smoothing", "temperature", "gradient_step_size", "deadline_ms")
        within(self, smoothing=(0.0, 1.0), keep_elite_fraction=(0.0, 1.0), white_noise_share=(0.0, 1.0))
        within(self, noise_beta=(0.0, STEEPEST_NOISE), min_std=(0.0, WIDEST_STD), overshoot=(0.0, 10.0))
        if isinstance(self.init_std, Real):  # a planner checks a std per action dimension, which it alone accepts
            within(self, init_std=(0.0, WIDEST_STD))
        for name in ("constraint_penalty", "policy_margin"):
            value = getattr(self, name)
            if value is not None and not 0.0 <= value < math.inf:
                raise ValueError(f"{name} must be finite and at least 0, got {value}")
        one_of(self, tail=("zero", "hold", "policy"), final=("mean", "best", "better"))
        self._check_spline()
        self._check_num_elites()
        if self.num_policy_samples is not None and self.num_policy_samples >= self.num_samples:
            raise ValueError(
                f"num_policy_samples ({self.num_policy_samples}) must be below num_samples ({self.num_samples})"
            )

    def _check_spline(self) -> None:
        one_of(self, action_spline=(None, "zero", "linear", "cubic"))
        shortest = min(self.horizon, self.goal_horizon or self.horizon)
        if self.num_knots is not None and self.action_spline is None:
            raise ValueError(f"num_knots ({self.num_knots}) needs action_spline: zero, linear or cubic")
        if self.num_knots is not None and self.num_knots > shortest:
            raise ValueError(f"num_knots ({self.num_knots}) must not exceed the horizon ({shortest})")

    def _check_num_elites(self) -> None:
        if self.num_elites is not None and self.num_elites > self.num_samples:
            raise ValueError(f"num_elites ({self.num_elites}) must not exceed num_samples ({self.num_samples})")

    @property
    def num_best(self) -> int:
        """Number of candidates that refit the search distribution."""
        return self.num_elites or max(1, round(ELITE_SHARE * self.num_samples))

    @property
    def num_kept(self) -> int:
        """Number of elites that stay candidates; at least one where any share is kept."""
        return 0 if self.keep_elite_fraction == 0 else max(1, round(self.keep_elite_fraction * self.num_best))

    def knots(self, horizon: int) -> int:
        """Returns the number of knots of a plan with `horizon` actions; 0 without a spline."""
        if self.action_spline is None:
            return 0
        return self.num_knots or min(horizon, max(2, math.ceil(horizon / 3)))

    @property
    def num_warm_iterations(self) -> int:
        """Number of refits of a search that starts from the previous plan."""
        return self.warm_start_iterations or math.ceil(self.num_iterations / 2)

    def num_proposals(self, has_policy: bool) -> int:
        """Returns the number of candidates that the policy of a model proposes.

        Args:
            has_policy: Whether the model has a policy.
        """
        if self.num_policy_samples is not None:
            return self.num_policy_samples
        return min(NUM_POLICY_SAMPLES, self.num_samples // 4) if has_policy else 0


@dataclass(frozen=True, kw_only=True)
class PlannerConfig(SearchOptions):
    """The planner of an agent, with the options of its search (`SearchOptions`).

    Six options have other defaults than in the planning library, because the agents were evaluated with them: a value
    that was learned is noisy, and its mistakes favour the best candidate more than the mean of the elites.

    Attributes:
        num_elites: Best candidates that refit the search distribution.
        final: See `SearchOptions`.
        noise_beta: See `SearchOptions`.
        keep_elite_fraction: See `SearchOptions`.
        policy_margin: See `SearchOptions`.
        use_continues: Whether the predicted probability that the episode goes on discounts the later rewards, which
            takes slower rollouts; null follows what a run has seen: true once an episode ended in a terminal state.
        method: Name of a registered planner, such as `cem`, `icem` or `mppi`. An option that has its default value is
            left to the planner: `icem` and `mppi` then take their own value.
        surprise_limit: Nats by which a frame may differ from the model's prediction (`WorldModel.surprise`). Where a
            frame differs by more, `--mode planner` executes the actor's action instead of the plan's, unless a goal or
            constraint is set. null always executes the plan.
    """

    num_elites: int | None = 16
    final: str = "mean"
    noise_beta: float = 0.0
    keep_elite_fraction: float = 0.0
    policy_margin: float | None = 0.01
    use_continues: bool | None = None  # type: ignore[assignment]  # wider than the option of a search
    method: str = "cem"
    surprise_limit: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        above_zero(self, "surprise_limit")

    def _check_num_elites(self) -> None:
        takes_default = self.method in TAKING_DEFAULT_ELITES
        if takes_default or self.num_elites != PlannerConfig.num_elites:  # else the method has its own number
            super()._check_num_elites()


def override_planner(trained: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """An agent's planner settings with the given ones in their place; a given `horizon` holds for goals too.

    Args:
        trained: Planner settings of the agent, by name.
        given: Settings that replace them, by name.
    """
    goal_horizon = {"goal_horizon": None} if "horizon" in given else {}
    return {**trained, **goal_horizon, **given}


def check_whole(options: Any, least: int, *names: str) -> None:
    """Requires options to be None or whole numbers of at least `least`."""
    for name in names:
        value = getattr(options, name)
        if value is not None and (isinstance(value, bool) or not isinstance(value, Integral) or value < least):
            raise ValueError(f"{name} must be a whole number, at least {least}, got {shown(value)}")
