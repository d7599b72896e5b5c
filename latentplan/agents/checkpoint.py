"""Checkpoints: a folder with weights, settings and metrics, checked when it is read."""

from __future__ import annotations

import difflib
import hashlib
import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save

from latentplan.agents.actor import ActorAgent
from latentplan.agents.background import BackgroundAgent
from latentplan.agents.gated import GatedAgent
from latentplan.agents.planning import PlanningAgent
from latentplan.agents.random import RandomAgent
from latentplan.config import Config, PlannerConfig, UserError, from_dict, to_dict
from latentplan.config.planner import override_planner
from latentplan.models import WorldModel
from latentplan.models.fast import accelerate

Agent = PlanningAgent | ActorAgent | RandomAgent
WEIGHTS = "weights.safetensors"
INFO = "info.json"
MODES = ("planner", "gated", "background", "actor", "random")
OPTIONS = {"gated": ("planning_budget", "signal"), "background": ("worker", "max_age", "fresh_ticks", "make_executor")}
KINDS = {
    "env_frames": int,
    "action_dim": int,
    "discount": int | float,
    "sha256": str,
    "labels": dict | None,
    "goal_dim": int | None,
}
REQUIRED = ("domain", "task", "env_frames", "discount", "action_dim", "config", "sha256")


def save_checkpoint(folder: Path, model: WorldModel, config: Config, info: dict[str, Any]) -> None:
    """Write an agent: float16 weights and a description, each replaced whole.

    Args:
        folder: Made when missing.
        model: What to keep; optimizer state is not part of an agent.
        config: Settings of the run.
        info: Facts beside them: domain, task, discount, env_frames, metrics and the like.

    Raises:
        FloatingPointError: A weight is not finite, or beyond what float16 holds.
    """
    folder.mkdir(parents=True, exist_ok=True)
    part = folder / f"{WEIGHTS}.part"
    state = {name: value.detach().cpu().half().contiguous() for name, value in model.state_dict().items()}
    if broken := _not_finite(state):
        raise FloatingPointError(f"{broken} is not finite in float16: {folder} is left as it was")
    content = save(state)
    part.write_bytes(content)
    digest = hashlib.sha256(content).hexdigest()
    sizes = {"action_dim": model.action_dim, "labels": model.labels, "goal_dim": model.goal_dim}
    facts = info | sizes | {"config": to_dict(config), "sha256": digest}
    (folder / f"{INFO}.part").write_text(json.dumps(facts, indent=1) + "\n")
    part.replace(folder / WEIGHTS)
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
    missing = [key for key in REQUIRED if not isinstance(info, dict) or key not in info]
    if missing:
        raise UserError(f"{folder} is not a latentplan checkpoint: {INFO} lacks {', '.join(missing)}")
    for key, kinds in KINDS.items():
        if not isinstance(info.get(key), kinds):
            raise UserError(f"{folder / INFO} cannot be used: {key} is {info.get(key)!r}")
    return info


def load_model(path: str | Path, device: str = "cpu") -> tuple[WorldModel, Config, dict[str, Any]]:
    """The world model of a checkpoint, its settings, and what it says of itself.

    Raises:
        UserError: The checkpoint is missing, foreign or damaged, or the device cannot be used.
    """
    info, folder = read_info(path), resolve_checkpoint(path)
    weights = folder / WEIGHTS
    try:
        content = weights.read_bytes()
    except OSError as error:
        raise UserError(f"{weights} cannot be read: {error.strerror}") from None
    if hashlib.sha256(content).hexdigest() != info["sha256"]:
        raise UserError(f"{weights} is damaged: its checksum is not the one in {INFO}")
    try:
        config = from_dict(info["config"])
    except (AttributeError, TypeError, ValueError) as error:
        raise UserError(f"the settings in {folder / INFO} cannot be used: {error}") from None
    try:
        model = WorldModel(config.model, info["action_dim"], info.get("labels"), info.get("goal_dim") or 0)
        state = {name: value.float() for name, value in load_file(weights).items()}
        model.load_state_dict(state)
    except (RuntimeError, SafetensorError, TypeError, ValueError) as error:
        raise UserError(f"{weights} does not fit its own settings: {str(error).splitlines()[0]}") from None
    if broken := _not_finite(state):
        raise UserError(f"{weights} cannot be used: {broken} is not finite")
    try:
        return accelerate(model.to(device)), config, info
    except (AssertionError, RuntimeError) as error:
        raise UserError(f"device {device!r} cannot be used: {str(error).splitlines()[0]}") from None


def load_agent(
    path: str | Path, mode: str = "planner", device: str = "cpu", **settings: Any
) -> Agent | BackgroundAgent:
    """A trained agent, ready to act.

    Args:
        path: A checkpoint, or a run folder.
        mode: `planner`, `actor`, `random`, `gated` (the actor, and the planner in doubt; see `GatedAgent`) or
            `background` (acts at once and plans beside, see `BackgroundAgent`; close it in the end).
        device: `cpu` or `cuda`.
        **settings: Settings of the search that replace the trained ones, such as `horizon=10`; `planning_budget` and
            `signal` of a gated agent; those of `BackgroundAgent` where it plans in the background.

    Raises:
        UserError: The checkpoint, the mode or a setting cannot be used.
    """
    if mode not in MODES:
        raise UserError(f"mode must be one of {', '.join(MODES)}, got {mode!r}")
    if settings and mode in ("actor", "random"):
        raise UserError(f"{next(iter(settings))} has no effect in mode {mode}: it does not plan")
    model, config, info = load_model(path, device)
    if mode == "random":
        return RandomAgent(model.action_dim)
    if mode == "actor":
        return ActorAgent(model, config)
    known = to_dict(config.planner)
    options = {name: settings.pop(name) for name in OPTIONS.get(mode, ()) if name in settings}
    for name in settings:
        if name not in known:
            names = (*known, *OPTIONS.get(mode, ()))
            raise UserError(f"unknown planner setting {name!r}{_suggestion(name, {key: key for key in names})}")
    kind: Any = {"planner": PlanningAgent, "gated": GatedAgent, "background": BackgroundAgent}[mode]
    try:
        agent: Agent | BackgroundAgent = kind(
            model, config, info["discount"], planner=PlannerConfig(**override_planner(known, settings)), **options
        )
    except (TypeError, ValueError) as error:
        raise UserError(f"planner settings: {error}") from None
    if isinstance(agent, BackgroundAgent):
        agent.wait_until_ready()  # so that the first episode is not one of the actor alone
    return agent


def resolve_checkpoint(path: str | Path) -> Path:
    """The checkpoint folder that a path means: itself, or the best or last one of a run.

    Raises:
        UserError: There is none.
    """
    root = Path(path)
    folder = _find(root)
    if folder is not None:
        return folder
    reason = f"expected {WEIGHTS} and {INFO}" if root.exists() else "the folder does not exist"
    parents = [parent for parent in (Path("checkpoints"), root.parent) if parent.is_dir()]
    known = {path.name: str(path) for parent in parents for path in sorted(parent.iterdir()) if _find(path)}
    raise UserError(f"no checkpoint at {root}: {reason}{_suggestion(root.name, known)}")


def _not_finite(state: dict[str, torch.Tensor]) -> str | None:
    """The name of the first of these that holds NaN or infinity."""
    return next((name for name, value in state.items() if not bool(torch.isfinite(value).all())), None)


def _find(root: Path) -> Path | None:
    """The root itself, or the best or last checkpoint of the run in it; None where there is none."""
    for folder in (root, root / "checkpoints" / "best", root / "checkpoints" / "last"):
        if (folder / INFO).is_file() and (folder / WEIGHTS).is_file():
            return folder
    return None


def _suggestion(name: str, known: dict[str, str]) -> str:
    """What to give in place of a name: the nearest of those known, else all of them."""
    nearest = difflib.get_close_matches(name, known, n=1)
    if nearest:
        return f"; did you mean {known[nearest[0]]}?"
    return f"; available: {', '.join(known.values())}" if known else ""
