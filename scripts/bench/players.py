"""Who plays a goal, by name."""

from __future__ import annotations

from typing import Any

from latentplan.agents.checkpoint import load_agent, load_model
from latentplan.agents.gated import GatedAgent
from latentplan.config import PlannerConfig, to_dict
from latentplan.config.planner import override_planner


class PlainGate(GatedAgent):
    """Plans at random decisions and acts by the actor at all others, whatever the goal."""

    _is_foreign = False  # so that the last plan is not followed


def make_player(player: str, checkpoint: str, device: str, planner: dict[str, Any]) -> Any:
    """The agent.

    Args:
        player: `planner`, `unconstrained`, `gated`, `random moments` (a gated agent that doubts at random), `random
            gate` (see `PlainGate`), `actor` or `random`.
        checkpoint: Folder of the trained agent or run.
        device: Where it computes.
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
