"""Settings of an agent's planner."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from latentplan.config.checks import above_zero
from latentplan.config.search import SearchOptions


@dataclass(frozen=True, kw_only=True)
class PlannerConfig(SearchOptions):
    """The planner of an agent, with the options of its search (`SearchOptions`).

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
    """An agent's planner settings with the given ones in their place; a given `horizon` holds for goals too.

    Args:
        trained: Planner settings of the agent, by name.
        given: Settings that replace them, by name.
    """
    goal_horizon = {"goal_horizon": None} if "horizon" in given else {}
    return {**trained, **goal_horizon, **given}
