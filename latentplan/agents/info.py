"""The description of a checkpoint, `info.json`: found, read and checked without torch."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, deserialize

from latentplan.agents.files import INFO, WEIGHTS, is_checkpoint, read_files
from latentplan.config import UserError
from latentplan.config.checks import cut, nearest, shown
from latentplan.config.reading import parse_json
from latentplan.config.spaces import Spaces

MOST_NAMES = 5  # known names in an error message
LARGEST_COUNT = 10**15  # of frames, updates and minutes; larger numbers are damage
LARGEST_SIZE = 4096  # of actions, labels and goals
DTYPES = ("F16", "BF16", "F32", "F64")  # of weights, as safetensors names them


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


def read_info(path: str | Path) -> dict[str, Any]:
    """The description of a checkpoint: domain, task, env_frames, config, metrics and so on.

    Args:
        path: A checkpoint, or a run folder (its best checkpoint, else its last).

    Raises:
        UserError: There is no checkpoint at the path, it is damaged, or another program wrote it.
    """
    return read_contents(resolve_checkpoint(path))[0]


def require_unchanged(path: str | Path, info: dict[str, Any]) -> None:
    """Refuses an agent that is no longer the one described, as a training run replaces its best agent.

    Args:
        path: A checkpoint or a run folder.
        info: What `read_info` found there before.

    Raises:
        UserError: Another agent is at the path, or none.
    """
    if read_info(path)["sha256"] != info["sha256"]:
        raise UserError(f"the agent in {path} was replaced meanwhile: call the command again, or give a copy of it")


def read_contents(folder: Path, *, is_sealed: bool = True) -> tuple[dict[str, Any], bytes]:
    """The description and the weights of a checkpoint, both checked.

    Args:
        folder: Folder of the checkpoint.
        is_sealed: Whether they must agree with the manifest, if there is one.

    Raises:
        UserError: The checkpoint is damaged, or another program wrote it.
    """
    contents = read_files(folder, (INFO, WEIGHTS), is_sealed=is_sealed)
    info = _parse(folder, contents[INFO])
    if hashlib.sha256(contents[WEIGHTS]).hexdigest() != info["sha256"]:
        raise UserError(f"{folder / WEIGHTS} is damaged: its checksum differs from the checksum in {INFO}")
    try:
        tensors = deserialize(contents[WEIGHTS])
    except SafetensorError as error:
        raise UserError(f"{folder / WEIGHTS} holds no weights: {error}") from None
    for name, tensor in tensors:
        if tensor["dtype"] not in DTYPES:
            raise UserError(
                f"{folder / WEIGHTS} cannot be used: {cut(name)} has dtype {tensor['dtype']}, and weights have one of "
                f"{', '.join(DTYPES)}"
            )
    return info, contents[WEIGHTS]


def read_spaces(info: dict[str, Any]) -> Spaces:
    """The spaces that a description names.

    Args:
        info: A description; see `read_info`.

    Raises:
        TypeError: The description names spaces of another form.
        ValueError: A value is not allowed.
    """
    given: dict[str, Any] = info.get("spaces", {})
    values: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value for name, value in given.items()}
    return Spaces(**values)


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
    parents = [parent for parent in (root, root.parent, Path("runs"), Path("checkpoints")) if parent.is_dir()]
    siblings = [sibling for parent in parents for sibling in sorted(parent.iterdir())]
    known: dict[str, str] = {}
    for sibling in filter(_find_checkpoint, siblings):
        known.setdefault(sibling.name, str(sibling))
    raise UserError(f"no checkpoint at {root}: {reason}{suggestion(root.name, known)}")


def suggestion(name: str, known: dict[str, str]) -> str:
    """The end of an error message about a name: the nearest known name, else the first known names."""
    similar = nearest(name, known, cutoff=0.6)
    if similar:
        return f"; did you mean {known[similar]}?"
    return f"; available: {', '.join([cut(name) for name in list(known.values())[:MOST_NAMES]])}" if known else ""


def _find_checkpoint(root: Path) -> Path | None:
    """The root if it is a checkpoint, or else the best or last checkpoint of a run in the root; None without one."""
    for folder in (root, root / "checkpoints" / "best", root / "checkpoints" / "last"):
        if is_checkpoint(folder, (INFO, WEIGHTS)):
            return folder
    return None


def _parse(folder: Path, content: bytes) -> dict[str, Any]:
    """The description of a checkpoint, checked."""
    info = parse_json(content.decode(errors="replace"), folder / INFO)
    missing = [key for key in REQUIRED_KEYS if not isinstance(info, dict) or key not in info]
    if missing:
        raise UserError(f"{folder} is not a latentplan checkpoint: {INFO} lacks {', '.join(missing)}")
    for key in info:
        if key not in ALLOWED:
            known = {name: name for name in ALLOWED}
            raise UserError(f"{folder / INFO} holds the unknown key {shown(key)}{suggestion(key, known)}")
    for key, (allows, allowed) in ALLOWED.items():
        if key in info and not allows(info[key]):
            raise UserError(f"{folder / INFO} cannot be used: {key} must be {allowed}, got {shown(info[key])}")
    return info
