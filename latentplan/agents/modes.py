"""The modes in which a trained agent can act: a table from the name of a mode to the agent's class.

The table needs the standard library only, so that commands can check a mode without importing torch.
A new mode is a file with its class and one line in `MODES`.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from latentplan.agents.base import Agent
    from latentplan.config import Config, PlannerConfig
    from latentplan.models import WorldModel


@dataclass(frozen=True)
class AgentMode:
    """One way to act with a trained world model.

    Attributes:
        maker: The class (or function) that makes the agent, as "module:name"; the module is imported at the first use.
            The maker is called as `maker(model, config, discount, planner=..., **options)` if `plans` is true, else as
            `maker(model, config, **options)`.
        plans: Whether the agent searches with the planner. A planning agent takes planner settings, and has the method
            `set_objective(objective, constraints)`.
        options: Keyword arguments of the maker that `load_agent` passes on beside the planner settings.
        one_thread: Whether a decision is so small that more than one CPU thread slows it down.
    """

    maker: str
    plans: bool = False
    options: tuple[str, ...] = ()
    one_thread: bool = False

    def load(self) -> Any:
        """Imports and returns the maker."""
        module, name = self.maker.split(":")
        return getattr(importlib.import_module(module), name)


_BACKGROUND_OPTIONS = ("worker", "max_age", "fresh_ticks", "make_executor")

MODES: dict[str, AgentMode] = {
    "planner": AgentMode("latentplan.agents.planning:PlanningAgent", plans=True),
    "gated": AgentMode("latentplan.agents.gated:GatedAgent", plans=True, options=("planning_budget", "signal")),
    "background": AgentMode(
        "latentplan.agents.background:BackgroundAgent", plans=True, options=_BACKGROUND_OPTIONS, one_thread=True
    ),
    "actor": AgentMode("latentplan.agents.actor:ActorAgent", one_thread=True),
    "random": AgentMode("latentplan.agents.random:random_agent"),
}


def planning_modes() -> tuple[str, ...]:
    """The names of the modes that plan, and so can pursue an objective given at test time."""
    return tuple(name for name, mode in MODES.items() if mode.plans)


def make_agent(
    mode: str,
    model: WorldModel,
    config: Config,
    discount: float,
    *,
    planner: PlannerConfig | None = None,
    **options: Any,
) -> Agent:
    """An agent that acts with a world model in one of the modes.

    Args:
        mode: A name in `MODES`.
        model: The world model.
        config: Settings the model was trained with.
        discount: Discount per decision, as learned; read by modes that plan.
        planner: Settings of the search, read by modes that plan; None takes the settings in `config`.
        **options: The mode's own options, see `AgentMode.options`.

    Raises:
        KeyError: There is no such mode.
        ValueError: An option's value is not allowed.
    """
    entry = MODES[mode]
    agent: Agent
    if entry.plans:
        agent = entry.load()(model, config, discount, planner=planner, **options)
    else:
        agent = entry.load()(model, config, **options)
    return agent
