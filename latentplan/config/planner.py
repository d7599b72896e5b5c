"""Settings of the planner."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from latentplan.config.checks import above_zero, at_least, one_of, within

WIDEST_STD = 1e15  # its square, and sums of such, are finite in float32
STEEPEST_NOISE = 100.0  # long before this all steps are one cosine; from 150 on powers overflow at some horizons


@dataclass(frozen=True)
class PlannerConfig:
    """CEM-MPC: the search over action sequences.

    Attributes:
        horizon: Model steps that a plan looks ahead.
        goal_horizon: The same for goals that are set after training; null takes `horizon`.
        num_samples: Candidate sequences per iteration.
        num_elites: Best candidates that refit the search distribution.
        num_iterations: Refits of a cold start.
        warm_start_iterations: Refits when the last plan is handed on.
        smoothing: Weight of the new statistics in the Polyak update of mean and variance, in (0, 1].
        init_std: Standard deviation at the start of a search, in action units.
        min_std: Floor of the sampling standard deviation, in action units.
        num_policy_samples: Candidates proposed by the actor, its own mode first; 0 leaves the actor out.
        warm_start: Whether a search starts from the shifted last plan.
        terminal_value: Whether the value of the last imagined state completes the return.
        use_continues: Whether the predicted probability of going on discounts what follows.
        start: Centre of the search: `shifted` (the last plan), `policy` (the actor's) or `both`.
        tail: What fills the end of the shifted plan: `zero`, `hold` or `policy`.
        warm_start_variance: Variance of a warm start: `reset`, `keep` or `inflate`.
        final: What is executed: the `mean` of the distribution, the `best` candidate, or the `better` of the mean and
            the actor's own plan, by their predicted returns.
        noise_beta: Exponent of coloured sampling noise, in [0, 100]; 0 is white.
        keep_elite_fraction: Share of the elites kept for the next iteration and the next plan.
        deadline_ms: Milliseconds that a search may take; null lets it do all its iterations.
        surprise_limit: Nats by which a frame may differ from what was predicted of it (`WorldModel.surprise`) for the
            plan from there to be trusted: beyond, the actor acts; null trusts it always. Heeded by `--mode planner`,
            unless a goal or constraint is set, of which the actor knows nothing.
    """

    horizon: int = 8
    goal_horizon: int | None = None
    num_samples: int = 128
    num_elites: int = 16
    num_iterations: int = 4
    warm_start_iterations: int = 2
    smoothing: float = 0.9
    init_std: float = 0.5
    min_std: float = 0.05
    num_policy_samples: int = 24
    warm_start: bool = True
    terminal_value: bool = True
    use_continues: bool = False
    start: str = "shifted"
    tail: str = "zero"
    warm_start_variance: str = "reset"
    final: str = "mean"
    noise_beta: float = 0.0
    keep_elite_fraction: float = 0.0
    deadline_ms: float | None = None
    surprise_limit: float | None = None

    def __post_init__(self) -> None:
        at_least(self, horizon=1, num_samples=2, num_elites=1, num_iterations=1, warm_start_iterations=1)
        at_least(self, num_policy_samples=0)
        above_zero(self, "goal_horizon", "smoothing", "deadline_ms", "surprise_limit")
        within(self, smoothing=(0.0, 1.0), keep_elite_fraction=(0.0, 1.0))
        within(self, noise_beta=(0.0, STEEPEST_NOISE), min_std=(0.0, WIDEST_STD), init_std=(0.0, WIDEST_STD))
        one_of(self, start=("shifted", "policy", "both"), tail=("zero", "hold", "policy"))
        one_of(self, warm_start_variance=("reset", "keep", "inflate"), final=("mean", "best", "better"))
        for name in ("num_elites", "num_policy_samples"):
            if getattr(self, name) > self.num_samples - (name == "num_policy_samples"):
                raise ValueError(f"{name} ({getattr(self, name)}) is too many for num_samples ({self.num_samples})")


def override_planner(trained: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """An agent's settings of the search with others in their place; a horizon that is given holds for goals too."""
    goal_horizon = {"goal_horizon": None} if "horizon" in given else {}
    return {**trained, **goal_horizon, **given}
