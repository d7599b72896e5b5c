"""Flags made of a dataclass of settings, and what commands that teach a trained agent ask with them."""

from __future__ import annotations

import dataclasses
import math
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from latentplan.config import DEVICES, UserError
from latentplan.config.files import raise_unknown

COMMON_FLAGS = {
    "--resume": ("DIR", "go on with the learning in this folder"),
    "--device": ("|".join(DEVICES), "where the agent computes (auto: cuda where usable)"),
    "--threads": ("N", "CPU threads (torch's own choice)"),
}


@dataclass(frozen=True)
class LearningRequest:
    """What the command line of teaching a trained agent asks for.

    Attributes:
        checkpoint: Folder of the agent to begin with; None when a learning resumes.
        out: Where the agent that has learned goes, or None for a folder of its own under `runs`.
        resume: Folder of the learning to go on with, or None.
        settings: Fields of the dataclass of settings that were given.
        device: `auto`, `cpu` or `cuda`.
        threads: CPU threads, or None to leave it to torch.
    """

    checkpoint: Path | None
    out: Path | None
    resume: Path | None
    settings: dict[str, Any]
    device: str
    threads: int | None


def read_request(settings: type, flags: Mapping[str, str], resumable: Sequence[str]) -> LearningRequest:
    """The request that flags make.

    Args:
        settings: The dataclass of settings.
        flags: By name, as they were typed.
        resumable: Those that may be given with `--resume`.

    Raises:
        UserError: A flag or value is wrong; the message says what to give.
    """
    if "--resume" in flags:
        for flag in flags:
            if flag not in ("--resume", *resumable):
                raise UserError(f"{flag} cannot be given with --resume; only {', '.join(resumable)} can")
    elif "--checkpoint" not in flags:
        raise UserError("flag --checkpoint is missing; give the folder of a trained agent or of a run")
    device = flags.get("--device", "auto")
    if device not in DEVICES:
        raise_unknown("device", device, DEVICES)
    checkpoint, out, resume = (
        Path(flags[flag]) if flag in flags else None for flag in ("--checkpoint", "--out", "--resume")
    )
    return LearningRequest(checkpoint, out, resume, read_settings(settings, flags), device, read_threads(flags))


def name_folder(kind: str, info: Mapping[str, Any]) -> Path:
    """A folder under `runs` for what an agent becomes: `runs/<kind>-<domain>-<task>-<date>`."""
    return Path("runs") / f"{kind}-{info['domain']}-{info['task']}-{datetime.now():%Y%m%d-%H%M%S}"


def setting_kinds(settings: type) -> dict[str, type]:
    """The flags that are fields of a dataclass of numbers, and whether each is `int` or `float`."""
    hints = typing.get_type_hints(settings)
    names = [field.name for field in dataclasses.fields(settings)]
    return {_flag(name): int if hints[name] is int else float for name in names}


def read_settings(settings: type, flags: Mapping[str, str]) -> dict[str, Any]:
    """The fields that were given, checked by the dataclass itself.

    Raises:
        UserError: A value is no number, or not one that is allowed.
    """
    given = {
        name: read_number(_flag(name), flags[_flag(name)], setting_kinds(settings)[_flag(name)])
        for name in (field.name for field in dataclasses.fields(settings))
        if _flag(name) in flags
    }
    try:
        settings(**given)
    except ValueError as error:
        name, _, rest = str(error).partition(" ")
        raise UserError(f"{_flag(name)} {rest}") from None
    return given


def read_number(flag: str, text: str, kind: type) -> Any:
    """The number of a flag.

    Raises:
        UserError: It is no finite number, or not whole where it has to be.
    """
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number) or (kind is int and number != int(number)):
        raise UserError(f"{flag} must be a {'whole ' if kind is int else ''}number, got {text!r}")
    return kind(number)


def read_threads(flags: Mapping[str, str]) -> int | None:
    """CPU threads as `--threads` has them; None without.

    Raises:
        UserError: It is no whole number from 1 on.
    """
    if "--threads" not in flags:
        return None
    threads = int(read_number("--threads", flags["--threads"], int))
    if threads < 1:
        raise UserError(f"--threads must be at least 1, got {threads}")
    return threads


def describe_settings(settings: type) -> list[tuple[str, str]]:
    """Each flag with a placeholder, and what it means, with its default."""
    lines = (settings.__doc__ or "").partition("Attributes:")[2].splitlines()
    meanings = dict(line.strip().split(": ", 1) for line in lines if ": " in line)
    rows = []
    for field in dataclasses.fields(settings):
        shown = "" if field.default is None else f" ({field.default:g})"
        rows.append((f"{_flag(field.name)} N", meanings[field.name].rstrip(".") + shown))
    return rows


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"
