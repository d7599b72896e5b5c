"""What settings have in common: how they are checked, how their errors read, how their seeds derive."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Any

MAX_THREADS = 1024  # more are refused before they exhaust the machine


class UserError(ValueError):
    """Something the user gave cannot work; the message is one line that says what to give instead."""


def derive_seed(seed: int, name: str, counter: int = 0) -> int:
    """A seed in [0, 2**31) for the stream `name` of a run, the same on every machine."""
    digest = hashlib.sha256(f"{seed}/{name}/{counter}".encode()).digest()
    return int.from_bytes(digest[:4], "little") >> 1


def make_folder(path: Path) -> None:
    """Make a folder for results, and those above it.

    Raises:
        UserError: It cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot make the folder {path}: {error.strerror}; choose another") from None


def output_file(path: Path, flag: str) -> Path:
    """The path, tried before any work is spent on what goes there; where a link leads, if it is one.

    Raises:
        UserError: It is a folder or a device, its folder does not exist, or nothing can be written in that.
    """
    import tempfile  # when there is a file to be written: every command imports this module

    given = str(path)
    if path.is_symlink():  # it stays, what it leads to is replaced
        path = Path(os.path.realpath(path))
        if path.is_symlink() or not path.parent.is_dir():
            raise UserError(f"{flag} {given!r} is a link that leads nowhere; give another name")
    folder = path.parent
    if path.is_dir():
        raise UserError(f"{flag} {given!r} is a folder; give a file in it")
    if path.exists() and not path.is_file():
        raise UserError(f"{flag} {given!r} is not a file, and would be replaced by one; give another name")
    if not folder.is_dir():
        existing = next(parent for parent in folder.parents if parent.is_dir())
        raise UserError(f"{flag}: there is no folder {str(folder)!r}; the nearest that exists is {str(existing)!r}")
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise UserError(f"{flag}: cannot write in {str(folder)!r}: {error.strerror}; choose another folder") from None
    return path


def at_least(config: Any, **bounds: float) -> None:
    """Require fields to be at least a bound."""
    for name, bound in bounds.items():
        _require(config, name, getattr(config, name) >= bound, f"at least {bound}")


def above_zero(config: Any, *names: str) -> None:
    """Require fields to be above 0, or None."""
    for name in names:
        value = getattr(config, name)
        _require(config, name, value is None or value > 0.0, "above 0")


def within(config: Any, **bounds: tuple[float, float]) -> None:
    """Require fields to lie in a closed interval."""
    for name, (low, high) in bounds.items():
        _require(config, name, low <= getattr(config, name) <= high, f"in [{low}, {high}]")


def one_of(config: Any, **choices: tuple[str, ...]) -> None:
    """Require fields to be one of the values allowed."""
    for name, allowed in choices.items():
        _require(config, name, getattr(config, name) in allowed, f"one of {', '.join(allowed)}")


def _require(config: Any, name: str, holds: bool, allowed: str) -> None:
    if not holds:
        raise ValueError(f"{name} must be {allowed}, got {getattr(config, name)!r}")
