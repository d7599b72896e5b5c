"""The settings that a dataclass declares, and the reading of their typed values from text by jsonargparse.

Names, types, defaults and meanings come from the dataclass alone, so that flags, YAML files and `--help` agree.
jsonargparse is imported when the first value is read, because `--help` does not need it.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import math
import re
import types
import typing
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from latentplan.config.checks import UserError, cut, nearest, shown
from latentplan.config.reading import is_shallow

_TYPE_WORDS = {
    int: "a whole number",
    float: "a finite number",
    bool: "true or false",
    str: "text",
    Path: "a path",
    type(None): "null",
}
_LARGEST = 10**18  # larger whole numbers are typing errors, and need more than the 64 bits of numpy and torch


@dataclass(frozen=True)
class Setting:
    """One field of a dataclass, as files and the command line name it.

    Attributes:
        key: Dotted name, such as `planner.horizon`.
        hint: Type of the values.
        default: Value unless one is given; `dataclasses.MISSING` where one must be given.
        meaning: Description of the field in the docstring of the dataclass.
        options: Metadata of the field.
    """

    key: str
    hint: Any
    default: Any
    meaning: str
    options: Mapping[str, Any]

    @property
    def choices(self) -> tuple[str, ...]:
        """The words that the setting allows, from a `Literal` or the option `choices`; empty where it allows others."""
        if "choices" in self.options:
            return tuple(self.options["choices"]())
        literals = (kind for kind in alternatives(self.hint) if typing.get_origin(kind) is typing.Literal)
        return next((typing.get_args(kind) for kind in literals), ())


def option(default: Any = dataclasses.MISSING, **options: Any) -> Any:
    """A field of a dataclass with notes for the command line.

    Args:
        default: The default; without one the flag must be given.
        options: `choices` (a function that returns the allowed words, for text), `metavar` (the placeholder for the
            value in `--help`), `join` (text between the values of a repeated flag), `separator` (text between the items
            of a tuple, which may also be words of their own), `is_output` (the flag names a file to be written),
            `is_positional` (the values are words without a flag; `metavar` is needed),
            `is_rare` (only `--help-all` shows the flag) and `is_last` (`--help` shows the flag after the others).
    """
    return dataclasses.field(default=default, metadata=options)


def list_settings(kind: type, prefix: str = "") -> list[Setting]:
    """Every setting of a dataclass and of the dataclasses inside it, in the order of their fields.

    Args:
        kind: The dataclass.
        prefix: First part of every key, such as `planner.`.
    """
    hints, meanings = typing.get_type_hints(kind), _meanings(kind)
    settings = []
    for field in dataclasses.fields(kind):
        key, hint = f"{prefix}{field.name}", hints[field.name]
        if dataclasses.is_dataclass(hint):
            settings += list_settings(typing.cast(type, hint), f"{key}.")
        else:
            default = field.default if field.default_factory is dataclasses.MISSING else field.default_factory()
            settings.append(Setting(key, hint, default, meanings.get(field.name, ""), field.metadata))
    return settings


def read_values(
    settings: Sequence[Setting], values: Mapping[str, Any], names: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """The values of settings, each with the type that its field has.

    Args:
        settings: Every setting that may have a value.
        values: Text or plain values, by key. `1e5` and `100000.0` are whole numbers.
        names: Names of settings in errors, by key; without one the key is used.

    Raises:
        UserError: A key is unknown or a value has the wrong type; the message names the setting, the value and what is
            allowed.
    """
    names = names or {}
    known = [setting.key for setting in settings]
    require_known("setting", values, known)
    texts = {setting.key: values[setting.key] for setting in settings if _is_text(setting, values)}
    for setting in settings:
        if setting.key in texts and setting.choices and texts[setting.key] not in setting.choices:
            raise _wrong_type(setting, values, names)
    given = [setting for setting in settings if setting.key in values and setting.key not in texts]
    return {**texts, **_parse_values(given, values, names)} if given else texts


def take_values(settings: Sequence[Setting], values: Mapping[str, Any]) -> dict[str, Any]:
    """The values that a program saved, checked and not parsed: lists become tuples, and 2.0 is a whole number.

    Args:
        settings: Every setting that may have a value.
        values: Plain values, by key.

    Raises:
        UserError: A key is unknown or a value has the wrong type; the message names the setting, the value and what is
            allowed.
    """
    known, taken = {setting.key: setting for setting in settings}, {}
    for key in values:
        require_known("setting", (key,), known)
        setting = known[key]
        value, kinds = _spell_numbers(setting, values[key]), alternatives(setting.hint)
        if isinstance(value, list):
            value = tuple(value)
        elif isinstance(value, float) and value.is_integer() and int in kinds and float not in kinds:
            value = int(value)
        if not fits(value, setting.hint):
            raise _wrong_type(setting, values, {})
        taken[key] = value
    return taken


def fits(value: Any, hint: Any) -> bool:
    """Whether a value has a type.

    Args:
        value: The value.
        hint: A class, a `Literal`, a `TypedDict`, a `tuple`, `list` or `dict` of such types, or several of them. Whole
            numbers have absolute values below 10**18, and are numbers too.
    """
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return any(fits(value, kind) for kind in inner)
    if origin is typing.Literal:
        return isinstance(value, str) and value in inner
    if typing.is_typeddict(hint):
        hints = typing.get_type_hints(hint)
        is_whole = isinstance(value, dict) and hint.__required_keys__ <= set(value)
        return is_whole and all(name not in value or fits(value[name], kind) for name, kind in hints.items())
    if origin is dict:
        return isinstance(value, dict) and all(fits(key, inner[0]) and fits(value[key], inner[1]) for key in value)
    if origin in (tuple, list):
        return isinstance(value, origin) and all(fits(item, inner[0]) for item in value)
    if type(value) is int:
        return hint in (int, float, Any) and abs(value) < _LARGEST
    return hint is Any or (isinstance(value, hint) and not (isinstance(value, bool) and hint is int))


def alternatives(hint: Any) -> tuple[Any, ...]:
    """The types that a hint allows: `int | None` as (int, NoneType), any other hint alone."""
    return typing.get_args(hint) if typing.get_origin(hint) in (typing.Union, types.UnionType) else (hint,)


def require_known(kind: str, names: Iterable[str], known: Collection[str]) -> None:
    """Refuses names that are not known; arguments and error are those of `raise_unknown`."""
    for name in names:
        if name not in known:
            raise_unknown(kind, name, known)


def raise_unknown(kind: str, name: str, known: Iterable[str]) -> typing.NoReturn:
    """Raise a `UserError` that names the nearest known name, or all of them where none is near.

    Args:
        kind: Kind of thing that the name belongs to, such as `domain`.
        name: The unknown name.
        known: The names that are allowed.
    """
    known = list(known)
    similar = nearest(name, known)
    few = f"; available: {', '.join(known)}" if len(known) <= 20 else "; --help-all lists all"
    raise UserError(f"unknown {kind} {shown(name)}" + (f"; did you mean {similar!r}?" if similar else few))


def _is_text(setting: Setting, values: Mapping[str, Any]) -> bool:
    """Whether a value is text for a setting that takes any text, so that nothing has to be parsed."""
    value = values.get(setting.key)
    return setting.hint is str and isinstance(value, str) and "\0" not in value


def _parse_values(given: Sequence[Setting], values: Mapping[str, Any], names: Mapping[str, str]) -> dict[str, Any]:
    import argparse

    from jsonargparse import ArgumentParser

    for setting in given:
        value = values[setting.key]
        if isinstance(value, str) and ("\0" in value or not is_shallow(value)):
            raise _wrong_type(setting, values, names)
    _register_numbers()
    parser = ArgumentParser(exit_on_error=False)
    for index, setting in enumerate(given):
        parser.add_argument(f"--value{index}", type=_parsed_type(setting.hint))
    texts = {f"value{index}": _spell_numbers(setting, values[setting.key]) for index, setting in enumerate(given)}
    try:
        parsed = parser.parse_object(texts, defaults=False)
    except argparse.ArgumentError as error:
        found = re.search(r'"value(\d+)', str(error))
        if found is None:
            raise UserError(str(error)) from None
        raise _wrong_type(given[int(found[1])], values, names) from None
    except (
        RecursionError,
        OverflowError,
        ValueError,
    ):  # thousands of brackets or digits
        if len(given) == 1:
            raise _wrong_type(given[0], values, names) from None
        return {key: value for setting in given for key, value in _parse_values([setting], values, names).items()}
    for index, setting in enumerate(given):
        if parsed[f"value{index}"] is None and type(None) not in alternatives(setting.hint):
            raise _wrong_type(setting, values, names)
    return {setting.key: parsed[f"value{index}"] for index, setting in enumerate(given)}


def _meanings(kind: type) -> dict[str, str]:
    """The descriptions under `Attributes:` in the docstrings of a dataclass and its bases, by field."""
    found = {}
    for base in reversed(kind.__mro__):
        attributes = inspect.cleandoc(vars(base).get("__doc__") or "").partition("Attributes:")[2]
        for name, text in re.findall(r"^ {4}(\w+): (.+(?:\n {5,}.+)*)", attributes, flags=re.MULTILINE):
            found[name] = " ".join(text.split())
    return found


class _WholeNumber(int):
    """The type that jsonargparse reads whole numbers with."""


class _FiniteNumber(float):
    """The type that jsonargparse reads other numbers with."""


@functools.cache
def _register_numbers() -> None:
    from jsonargparse.typing import register_type

    register_type(_WholeNumber, int, _whole_number, type_check=lambda value, _: _is_plain(value, int, _whole_number))
    register_type(
        _FiniteNumber, float, _finite_number, type_check=lambda value, _: _is_plain(value, float, _finite_number)
    )


def _is_plain(value: Any, kind: type, read: Callable[[Any], Any]) -> bool:
    """Whether a value needs no reading: it has the type, and lies in the range that `read` allows."""
    try:
        return type(value) is kind and read(value) == value
    except ValueError:
        return False


def _whole_number(value: Any) -> int:
    """The whole number that text such as `12`, `1e5` or `100000.0` stands for."""
    number = _finite_number(value)
    if not number.is_integer() or abs(number) >= _LARGEST:
        raise ValueError
    return int(number) if isinstance(value, float) or not re.fullmatch(r"[+-]?\d+", str(value)) else int(value)


def _finite_number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise ValueError
    try:
        number = float(value)
    except OverflowError:
        raise ValueError from None
    if not math.isfinite(number):
        raise ValueError
    return number


def _parsed_type(hint: Any) -> Any:
    """A hint with the number types that accept `1e5` for a whole number and refuse NaN and infinity."""
    numbers: dict[Any, Any] = {
        int: _WholeNumber,
        float: _FiniteNumber,
        tuple[int, ...]: tuple[_WholeNumber, ...],
        tuple[float, ...]: tuple[_FiniteNumber, ...],
    }
    kinds = [numbers.get(kind, kind) for kind in alternatives(hint)]
    return functools.reduce(lambda left, right: left | right, kinds)


def _spell_numbers(setting: Setting, value: Any) -> Any:
    """The value, with whole numbers as texts where the items are texts: `cameras: [0, 1]` names cameras 0 and 1."""
    if tuple[str, ...] not in alternatives(setting.hint) or not isinstance(value, list):
        return value
    return [str(item) if type(item) is int else item for item in value]


def _wrong_type(setting: Setting, values: Mapping[str, Any], names: Mapping[str, str]) -> UserError:
    name, value = names.get(setting.key, setting.key), values[setting.key]
    words = setting.choices
    if words:
        similar = nearest(value, words)
        hint = f"; did you mean {similar!r}?" if similar else ""
        return UserError(f"{name} must be one of {', '.join(words)}, got {shown(value)}{hint}")
    literals = [kind for kind in typing.get_args(setting.hint) if typing.get_origin(kind) is typing.Literal]
    if literals:  # a list of words
        items = typing.get_args(literals[0])
        wrong = next((item for item in value if item not in items), value) if isinstance(value, list) else value
        return UserError(f"each of {name} must be one of {', '.join(items)}, got {shown(wrong)}")
    separator = setting.options.get("separator")
    if separator:
        text = separator.join(map(str, value)) if isinstance(value, list | tuple) else value
        item = _TYPE_WORDS[typing.get_args(setting.hint)[0]].removeprefix("a ")
        if isinstance(value, str) and setting.key not in names:  # in a file
            example = cut(", ".join(part.strip() for part in value.split(separator)))
            return UserError(f"{name} must be a list of {item}s, such as [{example}], got {shown(value)}")
        return UserError(f"{name} must be {item}s, separated by {separator!r}, got {shown(text)}")
    example = '["speed -> 1.0"]' if str in typing.get_args(setting.hint) else "[16, 32]"
    wanted = " or ".join(_TYPE_WORDS.get(kind, f"a list such as {example}") for kind in alternatives(setting.hint))
    return UserError(f"{name} must be {wanted}, got {shown(value)}")
