"""Settings of an agent's planner."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from latentplan.config.checks import above_zero
from latentplan.config.search import SearchOptions

REMOVED: dict[str, tuple[Any, str]] = {
    "start": (
        "shifted",
        "a search starts from the shifted previous plan; raise planner.num_policy_samples to rely more on the policy",
    ),
    "warm_start_variance": (
        "reset",
        "a warm start resets the variance; lower planner.init_std to search closer to the previous plan",
    ),
}
"""Fields that `PlannerConfig` no longer has: the only value that is still accepted, and what to use instead."""


@dataclass(frozen=True, kw_only=True)
class PlannerConfig(SearchOptions):
    """The planner of an agent, and the options of its search; see `SearchOptions` for these.

    Attributes:
        method: Name of the planner in the registry of `latentplan.planning`: `cem`, `icem` or `mppi`. The options that
            have their default value are replaced by the method's own.
        surprise_limit: Nats by which a frame may differ from the model's prediction (`WorldModel.surprise`). Where a
            frame differs by more, `--mode planner` executes the actor's action instead of the plan's, unless a goal or
            constraint is set. null always executes the plan.
    """

    method: str = "cem"
    surprise_limit: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        above_zero(self, "surprise_limit")


def override_planner(trained: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """Returns an agent's planner settings with `given` ones in their place; a given horizon holds for goals too."""
    goal_horizon = {"goal_horizon": None} if "horizon" in given else {}
    return {**trained, **goal_horizon, **given}


def drop_removed(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Returns planner settings without the removed fields, which older files still hold.

    Raises:
        ValueError: A removed field has another value than the one that is still accepted.
    """
    for name, (accepted, advice) in REMOVED.items():
        if name in settings and settings[name] != accepted:
            raise ValueError(f"{name} {settings[name]!r} is no longer supported: {advice}")
    return {name: value for name, value in settings.items() if name not in REMOVED}
