"""Checkpoints: folders with the weights, settings and metrics of an agent, checked when they are read."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save

from latentplan.agents.base import Agent
from latentplan.agents.files import INFO, WEIGHTS, is_checkpoint, read_files, seal, write_files
from latentplan.agents.modes import MODES, make_agent
from latentplan.config import Config, PlannerConfig, UserError, from_dict, to_dict
from latentplan.config.checks import cut, nearest, shown
from latentplan.config.commit import MANIFEST
from latentplan.config.estimates import check_parts, estimate_search
from latentplan.config.planner import override_planner
from latentplan.config.reading import parse_json
from latentplan.config.spaces import Spaces
from latentplan.models import WorldModel
from latentplan.models.fast import accelerate
from latentplan.replay.memory import free_memory

MOST_NAMES = 5  # known names in an error message
LARGEST_COUNT = 10**15  # of frames, updates and minutes; larger numbers are damage
LARGEST_SIZE = 4096  # of actions, labels and goals


def _is_number(low: float, high: float, kinds: Any = (int, float)) -> tuple[Callable[[Any], bool], str]:
    """A check that a value is a number in [low, high], and the words for what is allowed."""

    def holds(value: Any) -> bool:
        return isinstance(value, kinds) and not isinstance(value, bool) and low <= value <= high

    return holds, f"{'an integer' if kinds is int else 'a number'} in [{low:g}, {high:g}]"


def _are_labels(value: Any) -> bool:
    is_scale, _ = _is_number(1e-9, 1e9)
    return value is None or (
        isinstance(value, dict) and len(value) <= LARGEST_SIZE and all(is_scale(scale) for scale in value.values())
    )


def _is_kind(kind: Any, words: str) -> tuple[Callable[[Any], bool], str]:
    return lambda value: isinstance(value, kind), words


ALLOWED: dict[str, tuple[Callable[[Any], bool], str]] = {
    "format": _is_number(1, 1, int),
    "version": _is_kind(str, "a text"),
    "domain": _is_kind(str, "a text"),
    "task": _is_kind(str, "a text"),
    "discount": _is_number(1e-3, 1.0),
    "renderer": _is_kind(dict, "a dictionary"),
    "env_frames": _is_number(0, LARGEST_COUNT, int),
    "updates": _is_number(0, LARGEST_COUNT, int),
    "minutes": _is_number(0, LARGEST_COUNT),
    "metrics": _is_kind((list, dict), "a list"),
    "final_evaluation": _is_kind(dict, "a dictionary"),
    "action_dim": _is_number(1, LARGEST_SIZE, int),
    "labels": (_are_labels, "a dictionary of scales above 0"),
    "goal_dim": (lambda value: value is None or _is_number(0, LARGEST_SIZE, int)[0](value), "a size"),
    "spaces": _is_kind(dict, "a dictionary"),
    "config": _is_kind(object, "settings"),
    "sha256": (lambda value: isinstance(value, str) and len(value) == 64, "a text of 64 digits"),
    "distilled": _is_kind(dict, "a dictionary"),
    "goals": _is_kind(dict, "a dictionary"),
}
REQUIRED_KEYS = ("domain", "task", "env_frames", "discount", "action_dim", "config", "sha256")


def save_checkpoint(folder: Path, model: WorldModel, config: Config, info: dict[str, Any]) -> None:
    """Writes a checkpoint: float16 weights, a description and a manifest, which replace earlier ones as one commit.

    Args:
        folder: Folder of the checkpoint; a missing folder is made.
        model: The world model.
        config: Settings of the run.
        info: Further facts for the description: domain, task, discount, env_frames, metrics and the like.

    Raises:
        FloatingPointError: A weight is not finite in float16; the folder is not changed.
    """
    state = {name: value.detach().cpu().half().contiguous() for name, value in model.state_dict().items()}
    if broken := _first_not_finite(state):
        raise FloatingPointError(f"{broken} is not finite in float16: {folder} is left as it was")
    content = save(state)
    sizes = {"action_dim": model.action_dim, "labels": model.labels, "goal_dim": model.goal_dim}
    if model.spaces != Spaces():
        sizes["spaces"] = to_dict(model.spaces)
    facts = info | sizes | {"config": to_dict(config), "sha256": hashlib.sha256(content).hexdigest()}
    write_files(folder, {WEIGHTS: content, INFO: (json.dumps(facts, indent=1) + "\n").encode()})


def seal_checkpoint(path: str | Path) -> None:
    """Writes a new manifest for a checkpoint whose `info.json` was edited on purpose.

    Args:
        path: A checkpoint, or a run folder.

    Raises:
        UserError: The checkpoint cannot be used as it is now.
    """
    folder = resolve_checkpoint(path)
    (folder / MANIFEST).unlink(missing_ok=True)
    load_model(folder)
    seal(folder, (INFO, WEIGHTS))


def read_info(path: str | Path) -> dict[str, Any]:
    """The description of a checkpoint: domain, task, env_frames, config, metrics and so on.

    Args:
        path: A checkpoint, or a run folder (its best checkpoint, else its last).

    Raises:
        UserError: There is no checkpoint at the path, or another program wrote it.
    """
    folder = resolve_checkpoint(path)
    return _parse_info(folder, read_files(folder, (INFO,))[INFO])


def _parse_info(folder: Path, content: bytes) -> dict[str, Any]:
    """The description of a checkpoint, checked."""
    info = parse_json(content.decode(errors="replace"), folder / INFO)
    missing = [key for key in REQUIRED_KEYS if not isinstance(info, dict) or key not in info]
    if missing:
        raise UserError(f"{folder} is not a latentplan checkpoint: {INFO} lacks {', '.join(missing)}")
    for key in info:
        if key not in ALLOWED:
            known = {name: name for name in ALLOWED}
            raise UserError(f"{folder / INFO} holds the unknown key {shown(key)}{_suggestion(key, known)}")
    for key, (allows, allowed) in ALLOWED.items():
        if key in info and not allows(info[key]):
            raise UserError(f"{folder / INFO} cannot be used: {key} must be {allowed}, got {shown(info[key])}")
    return info


def load_model(path: str | Path, device: str = "cpu") -> tuple[WorldModel, Config, dict[str, Any]]:
    """The world model of a checkpoint, the settings of its run, and the description (see `read_info`).

    Args:
        path: A checkpoint, or a run folder.
        device: `cpu` or `cuda`.

    Raises:
        UserError: The checkpoint is missing or damaged, another program wrote it, or the device cannot be used.
    """
    folder = resolve_checkpoint(path)
    contents = read_files(folder, (INFO, WEIGHTS))
    info, weights, content = _parse_info(folder, contents[INFO]), folder / WEIGHTS, contents[WEIGHTS]
    if hashlib.sha256(content).hexdigest() != info["sha256"]:
        raise UserError(f"{weights} is damaged: its checksum differs from the checksum in {INFO}")
    try:
        config = from_dict(info["config"])
    except (AttributeError, TypeError, ValueError) as error:
        raise UserError(f"the settings in {folder / INFO} cannot be used: {error}") from None
    try:
        sizes = info["action_dim"], info.get("labels"), info.get("goal_dim") or 0, _read_spaces(info)
        state = {name: value.float() for name, value in load(content).items()}
        with torch.device("meta"):  # compares shapes before a model is allocated whose size the file names
            WorldModel(config.model, *sizes).load_state_dict(state, assign=True)
        model = WorldModel(config.model, *sizes)
        model.load_state_dict(state)
    except (RuntimeError, SafetensorError, TypeError, ValueError) as error:
        raise UserError(f"{weights} does not fit its own settings: {str(error).splitlines()[-1].strip()}") from None
    if broken := _first_not_finite(state):
        raise UserError(f"{weights} cannot be used: {broken} is not finite")
    try:
        return accelerate(model.to(device)), config, info
    except (AssertionError, RuntimeError) as error:
        raise UserError(f"device {device!r} cannot be used: {str(error).splitlines()[0]}") from None


def load_agent(path: str | Path, mode: str = "planner", device: str = "cpu", **settings: Any) -> Agent:
    """A trained agent, ready to act.

    Args:
        path: A checkpoint, or a run folder (its best checkpoint, else its last).
        mode: `planner` (plans at every decision), `actor` (the learned policy alone), `gated` (the actor, and the
            planner at doubtful decisions; see `GatedAgent`), `background` (acts without waiting for the planner, and
            has to be closed; see `BackgroundAgent`) or `random`; see `latentplan.agents.modes`.
        device: `cpu` or `cuda`.
        **settings: For modes that plan, planner settings in place of the settings of the training, such as
            `horizon=10`. Also the mode's own options: `planning_budget` and `signal` of `gated`; `worker`, `max_age`,
            `fresh_ticks` and `make_executor` of `background`.

    Returns:
        An `Agent`: `act(frame)` takes uint8 frames (64, 64, 3) or (batch, 64, 64, 3) and returns float32 actions in
        [-1, 1], (action,) or (batch, action); call `reset()` before every episode.

    Raises:
        UserError: The checkpoint, the mode or a setting cannot be used.
    """
    if mode not in MODES:
        raise UserError(f"mode must be one of {', '.join(MODES)}, got {shown(mode)}")
    entry = MODES[mode]
    options = {name: settings.pop(name) for name in entry.options if name in settings}
    if settings and not entry.plans:
        raise UserError(f"{next(iter(settings))} has no effect in mode {mode}: it does not plan")
    model, config, info = load_model(path, device)
    known = to_dict(config.planner)
    for name in settings:
        if name not in known:
            names = (*known, *entry.options)
            raise UserError(f"unknown planner setting {name!r}{_suggestion(name, {key: key for key in names})}")
    try:
        planner = PlannerConfig(**override_planner(known, settings))
        if entry.plans:
            check_parts([estimate_search(planner, config.model, device != "cpu")], free_memory())
        agent = make_agent(mode, model, config, info["discount"], planner=planner, **options)
    except (TypeError, ValueError) as error:
        raise UserError(f"planner settings: {error}") from None
    wait_until_ready = getattr(agent, "wait_until_ready", None)
    if wait_until_ready is not None:
        wait_until_ready()  # without a ready worker, the actor alone would decide in the first episode
    return agent


def resolve_checkpoint(path: str | Path) -> Path:
    """The folder of the checkpoint at a path: the path itself, or the best or last checkpoint of a run folder.

    Raises:
        UserError: There is no checkpoint at the path.
    """
    root = Path(path)
    folder = _find_checkpoint(root)
    if folder is not None:
        return folder
    reason = f"expected {WEIGHTS} and {INFO}" if root.exists() else "the folder does not exist"
    parents = [parent for parent in (root.parent, Path("checkpoints")) if parent.is_dir()]
    siblings = [sibling for parent in parents for sibling in sorted(parent.iterdir())]
    known: dict[str, str] = {}
    for sibling in filter(_find_checkpoint, siblings):
        known.setdefault(sibling.name, str(sibling))
    raise UserError(f"no checkpoint at {root}: {reason}{_suggestion(root.name, known)}")


def _read_spaces(info: dict[str, Any]) -> Spaces:
    """The spaces that a description names.

    Raises:
        TypeError: The description names spaces of another form.
        ValueError: A value is not allowed.
    """
    given: dict[str, Any] = info.get("spaces", {})
    values: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value for name, value in given.items()}
    return Spaces(**values)


def _first_not_finite(state: dict[str, torch.Tensor]) -> str | None:
    """The name of the first tensor that holds NaN or infinity; None where all are finite."""
    return next((name for name, value in state.items() if not bool(torch.isfinite(value).all())), None)


def _find_checkpoint(root: Path) -> Path | None:
    """The root if it is a checkpoint, or else the best or last checkpoint of a run in the root; None without one."""
    for folder in (root, root / "checkpoints" / "best", root / "checkpoints" / "last"):
        if is_checkpoint(folder, (INFO, WEIGHTS)):
            return folder
    return None


def _suggestion(name: str, known: dict[str, str]) -> str:
    """The end of an error message about a name: the nearest known name, else the first known names."""
    similar = nearest(name, known, cutoff=0.6)
    if similar:
        return f"; did you mean {known[similar]}?"
    return f"; available: {', '.join([cut(name) for name in list(known.values())[:MOST_NAMES]])}" if known else ""
