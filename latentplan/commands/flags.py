"""Flags, help and errors of a command, derived from the dataclass of its request.

A field `control_hz` becomes the flag `--control-hz`; a field made by `overrides` stands for the settings of another
dataclass, as `--planner.horizon`. Types, defaults and meanings are those of the dataclass; its `__post_init__` checks
the values. `--help` prints the flags that people use and `--help-all` prints every flag.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from latentplan.config import UserError, output_file
from latentplan.config.earlier import REMOVED
from latentplan.config.parsing import Setting, alternatives, list_settings, raise_unknown, read_values

Request = TypeVar("Request")

GENERAL_FLAGS = {
    "--help": "print the flags that people use",
    "--help-all": "print every flag",
    "--print-config": "print the settings as YAML instead of running",
}
_METAVARS = {int: "N", float: "X", bool: "true|false", str: "TEXT", Path: "PATH", tuple: "[A,B]"}
_WIDTH = 110


@dataclass(frozen=True)
class Flag:
    """A setting on the command line.

    Attributes:
        names: Spellings of the flag, the usual one first.
        setting: The setting; its key is the path of the value inside the request.
        is_common: Whether `--help` shows the flag; `--help-all` shows every flag.
    """

    names: tuple[str, ...]
    setting: Setting
    is_common: bool

    @property
    def is_required(self) -> bool:
        """Whether the command cannot run without the flag."""
        return self.setting.default is dataclasses.MISSING

    @property
    def is_positional(self) -> bool:
        """Whether the values are given as words without a flag."""
        return bool(self.setting.options.get("is_positional"))

    @property
    def metavar(self) -> str:
        """The placeholder for the value in `--help`."""
        kind = alternatives(self.setting.hint)[0]
        shown = "|".join(self.setting.choices) or _METAVARS.get(getattr(kind, "__origin__", kind), "VALUE")
        if "separator" in self.setting.options:
            shown = self.setting.options["separator"].join(["A", "B", "..."])
        return str(self.setting.options.get("metavar", shown))

    @property
    def help(self) -> str:
        """The meaning of the flag, with its default where it has one."""
        default = self.setting.default
        if default in (None, dataclasses.MISSING, (), ""):
            return self.setting.meaning
        shown = str(default).lower() if isinstance(default, bool) else default
        if isinstance(default, tuple):
            separator = self.setting.options.get("separator")
            shown = separator.join(map(str, default)) if separator else list(default)
        return f"{self.setting.meaning} (default: {shown})"


def overrides(kind: type, short: Mapping[str, str] | None = None, prefix: str = "") -> Any:
    """A field that holds those settings of a dataclass that were given, by name: `{"horizon": 3}`.

    Args:
        kind: The dataclass; settings of dataclasses inside it are in nested dictionaries.
        short: Short names for settings, by dotted name: `{"run.frames": "--frames"}`.
        prefix: First part of every flag, such as `planner.`.
    """
    return field(default_factory=dict, metadata={"overrides": kind, "short": short or {}, "prefix": prefix})


def list_flags(request: type) -> list[Flag]:
    """The flags of a request, in the order in which `--help` prints them."""
    flags = []
    for setting in list_settings(request):
        kind = setting.options.get("overrides")
        if kind is None:
            name = setting.options["metavar"] if setting.options.get("is_positional") else _spelled(setting.key)
            flags.append(Flag((name,), setting, not setting.options.get("is_rare")))
            continue
        for inner in list_settings(kind):
            dotted = setting.options["prefix"] + inner.key
            short = setting.options["short"].get(inner.key)
            names = tuple(dict.fromkeys([*((short,) if short else ()), _spelled(dotted)]))
            is_common = short is not None or ("." not in dotted and not inner.options.get("is_rare"))
            flags.append(Flag(names, dataclasses.replace(inner, key=f"{setting.key}.{inner.key}"), is_common))
    return sorted(flags, key=lambda flag: bool(flag.setting.options.get("is_last")))


def read_request(request: type[Request], argv: Sequence[str]) -> Request:
    """The request that a command line makes.

    Raises:
        UserError: A flag or value is wrong or an output cannot be written; the message says what to give instead.
    """
    flags = list_flags(request)
    first = vars(request).get("FIRST")  # the flag that the first word needs not repeat
    if first is not None and argv and not argv[0].startswith("-"):
        argv = [first, *argv]
    names = {flag.setting.key: flag.names[0] for flag in flags}
    values = read_values([flag.setting for flag in flags], _read_texts(flags, argv), names)
    _check_lists(flags, values)
    _check_resumed(request, [names[key] for key in values])
    _check_outputs(flags, values)
    if "resume" in values and hasattr(request, "RESUMABLE"):
        _refuse_nulls({names[key]: value for key, value in values.items()})
    for flag in flags:
        if flag.is_required and flag.setting.key not in values:
            kind = "word" if flag.is_positional else "flag"
            raise UserError(f"{kind} {flag.names[0]} is missing; give the {_begin_small(flag.setting.meaning)}")
    nested: dict[str, Any] = {}
    for key, value in values.items():
        *path, name = key.split(".")
        folder = nested
        for part in path:
            folder = folder.setdefault(part, {})
        folder[name] = value
    try:
        return request(**nested)
    except UserError:
        raise
    except ValueError as error:
        first, _, rest = str(error).partition(" ")
        named = [name for key, name in names.items() if key.rpartition(".")[2] == first]
        raise UserError(f"{named[0] if named else first} {rest}") from None


def format_flags(request: type, program: str, summary: str, every_flag: bool) -> str:
    """The text of `--help`, or of `--help-all`.

    Args:
        request: Dataclass of the command's request; its `NOTES` end the text.
        program: How the command is called, such as `latentplan eval`.
        summary: One sentence on what the command does.
        every_flag: Whether the flags that are rarely used are shown too.
    """
    flags = list_flags(request)
    needed = [f"{flag.names[0]} {flag.metavar}" for flag in flags if flag.is_required and not flag.is_positional]
    needed += [_usage(flag) for flag in flags if flag.is_positional]
    parser = _Parser(
        [flag for flag in flags if flag.is_common or every_flag],
        usage=" ".join([program, *needed, "[--name value ...]"]),
    )
    parser.description = summary
    for flag in flags:
        if flag.is_positional:
            parser.add_argument(flag.setting.key, metavar=flag.metavar, help=flag.help.replace("%", "%%"))
    for name, meaning in GENERAL_FLAGS.items():
        parser.add_argument(name, action="store_true", help=meaning)
    notes = vars(request).get("NOTES", "")
    resumable = getattr(request, "RESUMABLE", ())
    parser.epilog = f"With --resume only {', '.join(resumable)} may be given. {notes}" if resumable else notes
    return parser.format_help()


class _Parser(argparse.ArgumentParser):
    """Reads flags as text; every mistake is a `UserError`, and a value may begin with one dash."""

    def __init__(self, flags: Sequence[Flag], usage: str | None = None) -> None:
        super().__init__(
            usage=usage, add_help=False, allow_abbrev=False, exit_on_error=False, formatter_class=_HelpFormatter
        )
        self.positional = next((flag for flag in flags if flag.is_positional), None)
        for flag in flags:
            options = flag.setting.options
            if flag.is_positional:
                continue
            several: dict[str, Any] = {"action": _Join, "const": options["join"]} if "join" in options else {}
            if "separator" in options:  # `0 1` is the list `0,1`
                several = {"nargs": "+"}
            self.add_argument(
                *flag.names,
                dest=flag.setting.key,
                metavar=flag.metavar,
                default=argparse.SUPPRESS,
                help=flag.help.replace("%", "%%"),
                **several,
            )

    def error(self, message: str) -> Any:
        """Raise the mistake that argparse found."""
        raise UserError(message)

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """The text of every flag that was given, the last one of a repeated flag."""
        try:
            found, others = self.parse_known_args(args, namespace)
        except argparse.ArgumentError as error:
            raise UserError(f"flag {str(error.argument_name).split('/')[0]} needs a value") from None
        if others and self.positional is not None:
            is_list = _takes_several(self.positional)
            setattr(found, self.positional.setting.key, others if is_list else others.pop(0))
            others = [] if is_list else others
        if others:
            raise UserError(f"unexpected argument {others[0]!r}; settings are given as --name value")
        return found

    def _parse_optional(self, arg_string: str) -> Any:
        """The flag that a word is, or None for a value; argparse calls this for every word."""
        if not arg_string.startswith("--"):
            return None
        name = arg_string.partition("=")[0]
        if name in self._option_string_actions:
            return super()._parse_optional(arg_string)
        if name in (*GENERAL_FLAGS, "--version"):  # without a value `call` has taken them away
            raise UserError(f"{name} takes no value: give {name} alone")
        removed = REMOVED.get(name[2:])
        if removed is not None:
            raise UserError(f"{name} no longer exists: {removed.advice}")
        raise_unknown("flag", name, [*self._option_string_actions, *GENERAL_FLAGS, "--version"])


class _Join(argparse.Action):
    """Joins the values of a repeated flag."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        earlier = getattr(namespace, self.dest, None)
        setattr(namespace, self.dest, values if earlier is None else f"{earlier}{self.const}{values}")


class _HelpFormatter(argparse.HelpFormatter):
    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=34, width=_WIDTH)

    def _format_action_invocation(self, action: argparse.Action) -> str:
        if not action.option_strings:
            return str(action.metavar)
        metavar = f" {action.metavar}" if action.metavar else ""
        return f"{', '.join(action.option_strings)}{metavar}"


def _takes_several(flag: Flag) -> bool:
    return getattr(flag.setting.hint, "__origin__", None) is tuple


def _usage(flag: Flag) -> str:
    """The words of a positional flag, as the first line of the help shows them."""
    words = f"{flag.metavar} [{flag.metavar} ...]" if _takes_several(flag) else flag.metavar
    return words if flag.is_required else f"[{words}]"


def _read_texts(flags: Sequence[Flag], argv: Sequence[str]) -> dict[str, Any]:
    """The text of every flag that was given, by key; lists are split, of one word or of several."""
    texts = vars(_Parser(flags).parse_args(list(argv)))
    for flag in flags:
        separator = flag.setting.options.get("separator")
        if separator and flag.setting.key in texts:
            text = separator.join(texts[flag.setting.key])
            is_yaml = text.startswith("[")  # a list as YAML writes it
            texts[flag.setting.key] = text if is_yaml else _split(flag.names[0], text, separator)
    return texts


def _check_lists(flags: Sequence[Flag], values: Mapping[str, Any]) -> None:
    """Refuses an empty list as YAML writes it, for which a command has nothing to do.

    A list that is empty by default may be empty, and so may a list among the settings of another dataclass: a run
    without trackers is a run.
    """
    for flag in flags:
        key, separator = flag.setting.key, flag.setting.options.get("separator")
        if separator and "." not in key and flag.setting.default != () and values.get(key) == ():
            raise _empty_list(flag.names[0], separator, "[]")


def _check_resumed(request: type, given: Sequence[str]) -> None:
    resumable = getattr(request, "RESUMABLE", ())
    if "--resume" in given:
        for name in given:
            if name not in ("--resume", *resumable):
                raise UserError(f"{name} cannot be given with --resume; only {', '.join(resumable)} can")


def _refuse_nulls(given: Mapping[str, Any]) -> None:
    """Refuses `null` beside --resume, where a setting without a value is one that was not given."""
    for name, value in given.items():
        if value is None:
            raise UserError(
                f"{name} cannot be null with --resume: leave it out to keep the saved value, or give another value"
            )


def _check_outputs(flags: Sequence[Flag], values: dict[str, Any]) -> None:
    """Try every file that is to be written, before any work is spent on it."""
    checked: dict[Path, str] = {}
    for flag in flags:
        key, name = flag.setting.key, flag.names[0]
        if flag.setting.options.get("is_output") and values.get(key) is not None:
            values[key] = output_file(values[key], name)
            other = checked.setdefault(values[key].resolve(), name)
            if other != name:
                raise UserError(f"{other} and {name} name the same file; give two")


def _split(name: str, text: str, separator: str) -> list[str]:
    """The distinct items of a list, in order."""
    items = list(dict.fromkeys(item.strip() for item in text.split(separator) if item.strip()))
    if not items:
        raise _empty_list(name, separator, text)
    return items


def _empty_list(name: str, separator: str, text: str) -> UserError:
    return UserError(f"{name} must name at least one, separated by {separator!r}, got {text!r}")


def _spelled(key: str) -> str:
    """`--control-hz` for `control_hz`; dotted names keep their underscores, as in YAML files."""
    return f"--{key}" if "." in key else f"--{key.replace('_', '-')}"


def _begin_small(sentence: str) -> str:
    """A sentence without its dot that goes on in another sentence; a first word in capitals, such as YAML, stays."""
    keeps = sentence[1:2].isupper()
    return (sentence if keeps else sentence[:1].lower() + sentence[1:]).rstrip(".")
