"""Planners by name, and the protocol of a planner.

A new planner is one module with a class that satisfies `Planner`, one line in `PLANNERS`, and its name in `METHODS` of
`latentplan.config.planner`, from which commands know it before they import torch.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from latentplan.config.parsing import raise_unknown
from latentplan.config.planner import SearchOptions
from latentplan.planning.model import Bound, State
from latentplan.planning.objectives import Constraint, Term
from latentplan.planning.plan import Plan
from latentplan.planning.search.cem import (
    OWN_OPTIONS,
    CEMPlanner,
    cem_gradient_planner,
    icem_planner,
    mppi_planner,
)
from latentplan.planning.search.sampling import Generators


class SupportsPlan(Protocol):
    """An object that searches plans, without the attributes that a `Planner` also has."""

    def plan(
        self,
        model: Any,
        state: State,
        previous: Plan | None = None,
        *,
        objective: Term | None = None,
        constraints: Sequence[Constraint] = (),
        generator: Generators = None,
        deadline_ms: float | None = None,
    ) -> Plan:
        """Returns the best plan found from each state; see `CEMPlanner.plan` for the arguments.

        The `info` of the plan must hold `is_fallback`, `is_policy` and `num_nonfinite`, each (batch,).
        """
        ...


class Planner(SupportsPlan, Protocol):
    """The protocol of a planner for controllers, schedulers and agents. A planner keeps no plan between calls."""

    @property
    def action_dim(self) -> int:
        """Numbers in an action."""
        ...

    @property
    def action_low(self) -> Bound:
        """Lowest action, one number or one per dimension."""
        ...

    @property
    def action_high(self) -> Bound:
        """Highest action, one number or one per dimension."""
        ...

    @property
    def discount(self) -> float:
        """Discount per model step, in (0, 1]."""
        ...

    @property
    def horizon(self) -> int:
        """Model steps of a plan for the predicted return."""
        ...

    @property
    def goal_horizon(self) -> int | None:
        """Model steps of a plan for another objective; None is `horizon`."""
        ...

    @property
    def min_std(self) -> float:
        """Floor of the sampling standard deviation, in action units; 0 without one."""
        ...

    @property
    def terminal_value(self) -> bool | None:
        """Whether the model's value completes the predicted return; None where the model has a value."""
        ...


PLANNERS: dict[str, Callable[..., Planner]] = {
    "cem": CEMPlanner,
    "cem_gradient": cem_gradient_planner,
    "icem": icem_planner,
    "mppi": mppi_planner,
}
"""By name, the function that makes a planner from keyword arguments: the problem (`action_dim`, `action_low`,
`action_high`, `discount`), and any option of `SearchOptions`."""


def make_planner(name: str, options: SearchOptions | None = None, **settings: Any) -> Planner:
    """Returns the planner that is registered under a name.

    An option of `options` that has its default value is not passed on if the planner has its own value for it, as
    `icem` and `mppi` have for some options; a planner that is registered later chooses all defaults itself.

    Args:
        name: A name in `PLANNERS`.
        options: Options of the search, such as an agent's `PlannerConfig`; None passes none.
        **settings: The problem (`action_dim`, `action_low`, `action_high`, `discount`), and options that replace the
            values of `options` and of the planner; default values are passed on too.

    Raises:
        UserError: There is no planner of this name; the message names the nearest one.
        ValueError: An option has a value that is not allowed.
    """
    if name not in PLANNERS:
        raise_unknown("planner", name, PLANNERS)
    changed: dict[str, Any] = {}
    if options is not None:
        names = {field.name for field in dataclasses.fields(SearchOptions)}
        own = OWN_OPTIONS.get(PLANNERS[name], names)  # a planner of the user chooses all its defaults
        for field in dataclasses.fields(options):  # an agent's settings have defaults of their own
            value = getattr(options, field.name)
            if field.name in names and (field.name not in own or value != field.default):
                changed[field.name] = value
    return PLANNERS[name](**changed | settings)
