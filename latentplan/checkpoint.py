"""Checkpoints: a folder with weights, settings and metrics, checked when it is read."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from safetensors.torch import load_file, save_file

from latentplan.agent import ActorAgent, Agent, PlanningAgent, RandomAgent
from latentplan.config import Config, PlannerConfig, UserError, from_dict, to_dict
from latentplan.models import WorldModel

WEIGHTS = "weights.safetensors"
INFO = "info.json"
MODES = ("planner", "actor", "random")


def save_checkpoint(folder: Path, model: WorldModel, config: Config, info: dict[str, Any]) -> None:
    """Write an agent: float16 weights and a description, each replaced whole.

    Args:
        folder: Made when missing.
        model: What to keep; optimizer state is not part of an agent.
        config: Settings of the run.
        info: Facts beside them: domain, task, discount, env_frames, metrics and the like.
    """
    folder.mkdir(parents=True, exist_ok=True)
    part = folder / f"{WEIGHTS}.part"
    save_file({name: value.detach().cpu().half().contiguous() for name, value in model.state_dict().items()}, part)
    digest = hashlib.sha256(part.read_bytes()).hexdigest()
    facts = info | {"action_dim": model.action_dim, "config": to_dict(config), "sha256": digest}
    part.replace(folder / WEIGHTS)
    (folder / f"{INFO}.part").write_text(json.dumps(facts, indent=1))
    (folder / f"{INFO}.part").replace(folder / INFO)


def read_info(path: str | Path) -> dict[str, Any]:
    """What a checkpoint says of itself: domain, task, env_frames, config, metrics and so on.

    Args:
        path: A checkpoint, or a run folder (its best checkpoint, else its last).

    Raises:
        UserError: There is no checkpoint at the path, or it is not one of this program's.
    """
    folder = resolve_checkpoint(path)
    try:
        info = json.loads((folder / INFO).read_text())
    except (OSError, ValueError) as error:
        raise UserError(f"{folder / INFO} cannot be read: {error}") from None
    missing = [key for key in ("config", "sha256", "action_dim", "discount") if key not in info]
    if missing:
        raise UserError(f"{folder} is not a latentplan checkpoint: {INFO} lacks {', '.join(missing)}")
    return info


def load_model(path: str | Path, device: str = "cpu") -> tuple[WorldModel, Config, dict[str, Any]]:
    """The world model of a checkpoint, its settings, and what it says of itself.

    Raises:
        UserError: The checkpoint is missing, foreign or damaged.
    """
    info, folder = read_info(path), resolve_checkpoint(path)
    weights = folder / WEIGHTS
    if hashlib.sha256(weights.read_bytes()).hexdigest() != info["sha256"]:
        raise UserError(f"{weights} is damaged: its checksum is not the one in {INFO}")
    config = from_dict(info["config"])
    model = WorldModel(config.model, info["action_dim"])
    state = {name: value.float() for name, value in load_file(weights).items()}
    try:
        model.load_state_dict(state)
    except RuntimeError as error:
        raise UserError(f"{weights} does not fit its own settings: {str(error).splitlines()[0]}") from None
    return model.to(device), config, info


def load_agent(path: str | Path, mode: str = "planner", device: str = "cpu", **planner: Any) -> Agent:
    """A trained agent, ready to act.

    Args:
        path: A checkpoint, or a run folder.
        mode: `planner`, `actor` or `random`.
        device: `cpu` or `cuda`.
        **planner: Settings of the search that replace the trained ones, such as `horizon=10`.

    Raises:
        UserError: The checkpoint, the mode or a setting cannot be used.
    """
    if mode not in MODES:
        raise UserError(f"mode must be one of {', '.join(MODES)}, got {mode!r}")
    model, config, info = load_model(path, device)
    if mode == "random":
        return RandomAgent(model.action_dim)
    if mode == "actor":
        return ActorAgent(model, config)
    try:
        settings = PlannerConfig(**(to_dict(config.planner) | planner))
    except (TypeError, ValueError) as error:
        raise UserError(f"planner settings: {error}") from None
    return PlanningAgent(model, config, info["discount"], planner=settings)


def resolve_checkpoint(path: str | Path) -> Path:
    """The checkpoint folder that a path means: itself, or the best or last one of a run.

    Raises:
        UserError: There is none.
    """
    root = Path(path)
    for folder in (root, root / "checkpoints" / "best", root / "checkpoints" / "last"):
        if (folder / INFO).exists() and (folder / WEIGHTS).exists():
            return folder
    if not root.exists():
        raise UserError(f"no checkpoint at {root}: the folder does not exist{_nearby(root)}")
    raise UserError(f"no checkpoint at {root}: expected {WEIGHTS} and {INFO}{_nearby(root)}")


def _nearby(root: Path) -> str:
    parent = root.parent if root.parent.is_dir() else Path("checkpoints")
    names = sorted(str(path.parent) for path in parent.glob(f"*/{INFO}"))
    return f"; available: {', '.join(names)}" if names else ""
