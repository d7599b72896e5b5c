"""Agents of the zero-shot benchmark, by the name of their row."""

from __future__ import annotations

from typing import Any

from latentplan.agents.checkpoint import load_agent, load_model
from latentplan.agents.gated import GatedAgent
from latentplan.config import PlannerConfig, to_dict
from latentplan.config.planner import override_planner


class PlainGate(GatedAgent):
    """Plans at random decisions and acts by the actor at all other decisions, whatever the objective."""

    _is_goal_untrained = False  # so that between plans the actor acts, and not the rest of the last plan


def load_zero_shot_agent(player: str, checkpoint: str, device: str, planner: dict[str, Any]) -> Any:
    """The agent of a row.

    Args:
        player: `planner`, `unconstrained`, `gated`, `random moments` (a gated agent that plans at random decisions),
            `random gate` (see `PlainGate`), `actor` or `random`.
        checkpoint: Folder of the trained agent or run.
        device: Device of the agent, `cpu` or `cuda`.
        planner: Settings of the search that differ from the agent's.
    """
    if player == "random gate":
        model, config, info = load_model(checkpoint, device)
        search = PlannerConfig(**override_planner(to_dict(config.planner), planner))
        return PlainGate(model, config, info["discount"], signal="random", planner=search)
    if player in ("actor", "random"):
        return load_agent(checkpoint, mode=player, device=device)
    if player == "random moments":
        return load_agent(checkpoint, mode="gated", device=device, signal="random", **planner)
    mode = "gated" if player == "gated" else "planner"
    return load_agent(checkpoint, mode=mode, device=device, **planner)
