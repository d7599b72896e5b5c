"""Flags made of the fields of a dataclass of settings, whose docstring tells what they mean."""

from __future__ import annotations

import dataclasses
import math
import typing
from collections.abc import Mapping
from typing import Any

from latentplan.config import UserError


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
