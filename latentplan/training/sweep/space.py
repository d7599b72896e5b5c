"""The space of a sweep: the settings that its trials vary, and the values that each may take."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from latentplan.config import Config, UserError
from latentplan.config.checks import shown
from latentplan.config.files import Layer, read_layer
from latentplan.config.parsing import alternatives, list_settings


@dataclass(frozen=True)
class Range:
    """Numbers between two ends, which both belong to it.

    Attributes:
        low: Lower end.
        high: Upper end.
        is_log: Whether the logarithm is drawn evenly, in place of the number.
        is_whole: Whether only whole numbers belong to it.
    """

    low: float
    high: float
    is_log: bool
    is_whole: bool


Space = dict[str, Range | tuple[Any, ...]]


def read_space(path: Path) -> Space:
    """The values of each setting that a YAML file names: a `Range`, or a tuple of values to choose from.

    The file has sections and settings, as a file for `--config` has. A setting is a list of values, or has the keys
    `low`, `high` and, where its logarithm is drawn evenly, `log: true`.

    Raises:
        UserError: The file cannot be read, names no setting or an unknown one, or one that a sweep cannot vary.
    """
    hints = {setting.key: setting.hint for setting in list_settings(Config)}
    space: Space = {}
    for section, fields in read_layer(path).items():
        for name, value in fields.items():
            key = f"{section}.{name}"
            if section == "run":
                raise UserError(f"{path}: a sweep cannot vary {key}; give it as a flag")
            try:
                space[key] = _read_values(value, alternatives(hints[key]))
            except ValueError as error:
                raise UserError(f"{path}: {key} {error}") from None
    if not space:
        raise UserError(f"{path} names no setting to vary; see the guide 'Clusters' for an example")
    return space


def ends_of(space: Space) -> list[Layer]:
    """Values that show whether the whole space is allowed: for each setting its ends, or all of its choices."""
    found = []
    for key, values in space.items():
        each = (values.low, values.high) if isinstance(values, Range) else values
        found += [as_layer({key: int(value) if _is_whole(values) else value}) for value in each]
    return found


def as_layer(values: dict[str, Any]) -> Layer:
    """Values by dotted name as sections."""
    layer: Layer = {}
    for key, value in values.items():
        section, _, name = key.partition(".")
        layer.setdefault(section, {})[name] = value
    return layer


def _is_whole(values: Range | tuple[Any, ...]) -> bool:
    return isinstance(values, Range) and values.is_whole


def _read_values(value: Any, kinds: tuple[Any, ...]) -> Range | tuple[Any, ...]:
    if isinstance(value, list):
        if not value or not all(isinstance(item, str | int | float | bool | None) for item in value):
            raise ValueError(f"must list numbers, words or null, got {shown(value)}")
        return tuple(value)
    if not isinstance(value, dict) or not {"low", "high"} <= value.keys() <= {"low", "high", "log"}:
        raise ValueError(f"must be a list of values, or have low, high and perhaps log, got {shown(value)}")
    if not {int, float} & set(kinds):
        raise ValueError("is no number: list its values")
    low, high = (_read_number(value[end]) for end in ("low", "high"))
    is_log, is_whole = value.get("log", False), float not in kinds
    if not isinstance(is_log, bool):
        raise ValueError(f"log must be true or false, got {shown(is_log)}")
    if is_whole and not (low.is_integer() and high.is_integer()):
        raise ValueError(f"needs whole numbers as low and high, got {low:g} and {high:g}")
    if low >= high:
        raise ValueError(f"low ({low:g}) must be below high ({high:g})")
    if is_log and low <= 0.0:
        raise ValueError(f"low must be above 0 with log: true, got {low:g}")
    return Range(low, high, is_log, is_whole)


def _read_number(value: Any) -> float:
    """A number; YAML reads `1e-4` as text."""
    try:
        number = float(value) if isinstance(value, str | int | float) and not isinstance(value, bool) else math.nan
    except (ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"needs numbers as low and high, got {shown(value)}")
    return number
