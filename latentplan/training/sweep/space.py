"""The space of a sweep: the settings that its trials vary, and the values that each may take."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from latentplan.config import Config, UserError
from latentplan.config.checks import shown
from latentplan.config.files import Layer, read_layer
from latentplan.config.parsing import alternatives, list_settings

MOST_COMBINATIONS = 64  # that are tried beside one value


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
    """For each setting in turn its ends, or all of its choices, as sections.

    Of whole numbers the one after the lower end comes too: the setting may have gaps, as the sizes of frames.
    """
    return [as_layer({key: value}) for key, values in space.items() for value in (*_ends(values), *_inner(values))]


def check_space(space: Space, check: Callable[[Layer], object]) -> Layer:
    """Values of all settings that are allowed; refuses a space where an end or a choice has no such values beside it.

    Of the combinations of ends and choices, all are tried, or 64 that are drawn where there are more.

    Args:
        space: The space.
        check: Raises UserError for values that no trial may have.

    Raises:
        UserError: An end or a choice is allowed in no combination; the message is that of the first one tried.
    """
    allowed: Layer = {}
    for end in ends_of(space):
        reason = None
        for others in _combinations(space):
            allowed = {**others, **{section: {**others[section], **fields} for section, fields in end.items()}}
            try:
                check(allowed)
                break
            except UserError as error:
                reason = reason or error
        else:
            assert reason is not None
            raise reason
    return allowed


def _combinations(space: Space) -> Iterator[Layer]:
    """Values of all settings, each an end of its range or one of its choices."""
    keys, ends = list(space), [_ends(values) for values in space.values()]
    if math.prod(map(len, ends)) <= MOST_COMBINATIONS:
        combinations: Iterable[tuple[Any, ...]] = itertools.product(*ends)
    else:
        draw = random.Random(0)
        combinations = (tuple(map(draw.choice, ends)) for _ in range(MOST_COMBINATIONS))
    return (as_layer(dict(zip(keys, values, strict=True))) for values in combinations)


def as_layer(values: dict[str, Any]) -> Layer:
    """Values by dotted name as sections."""
    layer: Layer = {}
    for key, value in values.items():
        section, _, name = key.partition(".")
        layer.setdefault(section, {})[name] = value
    return layer


def _ends(values: Range | tuple[Any, ...]) -> tuple[Any, ...]:
    if not isinstance(values, Range):
        return values
    return tuple(int(end) if values.is_whole else end for end in (values.low, values.high))


def _inner(values: Range | tuple[Any, ...]) -> tuple[int, ...]:
    is_wide = isinstance(values, Range) and values.is_whole and values.high - values.low > 1.0
    return (int(values.low) + 1,) if isinstance(values, Range) and is_wide else ()


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
