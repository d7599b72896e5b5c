"""Texts that users give as files, read within limits: regular files only, of a bounded size and depth.

A device or a pipe would make the program wait for ever, a large file would fill the memory, and nested brackets would
exhaust the stack of a parser.
"""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from latentplan.config.checks import UserError, shown

LARGEST_SETTINGS = 2**20  # bytes of a file of settings
LARGEST_DATA = 2**26  # bytes of a file of measurements
DEEPEST = 32  # levels of nested lists and dictionaries
_BLOCK = 2**22  # bytes of one read


def read_text(path: Path, largest: int = LARGEST_SETTINGS) -> str:
    """The text of a regular file.

    Args:
        path: The file; a link is followed.
        largest: Largest size in bytes.

    Raises:
        UserError: The file is missing, is no regular file, is too large, or holds no text.
    """
    try:
        return read_bytes(path, largest).decode()
    except UnicodeDecodeError:
        raise UserError(f"cannot read {path}: not a text file") from None


def read_bytes(path: Path, largest: int) -> bytes:
    """The content of a regular file.

    Args:
        path: The file; a link is followed.
        largest: Largest size in bytes.

    Raises:
        UserError: The file is missing, is no regular file, or is too large.
    """
    try:
        opened = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # a pipe without a writer would block
        try:
            mode = os.fstat(opened).st_mode
            content = b"".join(_read_parts(opened, largest + 1)) if stat.S_ISREG(mode) else None
        finally:
            os.close(opened)
    except (OSError, ValueError) as error:
        raise UserError(f"cannot read {path}: {getattr(error, 'strerror', None) or 'no such name'}") from None
    if content is None:
        raise UserError(f"cannot read {path}: it is {'a folder' if stat.S_ISDIR(mode) else 'not a regular file'}")
    if len(content) > largest:
        raise UserError(f"cannot read {path}: it has more than {largest:,} bytes")
    return content


def read_yaml(path: Path) -> Any:
    """The content of a YAML file of settings, made of plain values.

    Raises:
        UserError: The file cannot be read (see `read_text`), is not valid YAML, is nested too deeply, has aliases, or
            gives a key twice.
    """
    import yaml

    text = read_text(path)
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        if (reason := _find_excess(text)) is not None:
            raise UserError(f"cannot read {path}: {reason}")
        return yaml.load(text, Loader=loader)  # a safe loader makes plain values only
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f"line {mark.line + 1}: " if mark else ""
        raise UserError(f"{path} is not valid YAML: {where}{getattr(error, 'problem', None) or error}") from None
    except (ValueError, OverflowError) as error:  # a date or a number that does not exist
        if isinstance(error, UserError):
            raise
        raise UserError(f"{path} is not valid YAML: it holds a value that cannot be read") from None


def parse_json(text: str, path: Path | str) -> Any:
    """The content of a JSON text.

    Args:
        text: The text.
        path: The file that the text came from, for errors.

    Raises:
        UserError: The text is not valid JSON, is nested too deeply, or has numbers of thousands of digits.
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise UserError(f"{path} cannot be read: it is nested too deeply") from None
    except ValueError as error:
        reason = str(error) if isinstance(error, json.JSONDecodeError) else "it holds a number that is too long"
        raise UserError(f"{path} cannot be read: {reason}") from None


def read_kwargs(text: str) -> dict[str, Any]:
    """The arguments of an environment.

    Args:
        text: A JSON object.

    Raises:
        ValueError: The text is something else.
    """
    example = """'{"max_episode_steps": 200}'"""
    try:
        kwargs = json.loads(text)
    except (ValueError, RecursionError, TypeError) as error:
        reason = f": {error}" if isinstance(error, json.JSONDecodeError) else ""
        raise ValueError(f"kwargs must be a JSON object such as {example}, got {shown(text)}{reason}") from None
    if not isinstance(kwargs, dict):
        raise ValueError(f"kwargs must be a JSON object such as {example}, got {shown(text)}")
    return kwargs


def _read_parts(opened: int, size: int) -> Iterator[bytes]:
    """The first bytes of an open file."""
    while size > 0 and (part := os.read(opened, min(size, _BLOCK))):  # memory is taken for all that is asked for
        size -= len(part)
        yield part


def is_shallow(text: str) -> bool:
    """Whether a text that may be YAML can be parsed without a deep stack."""
    import yaml

    try:
        return _find_excess(text, may_repeat=True) is None
    except (ValueError, yaml.YAMLError):
        return True  # the parser stops at the same place, before the text is deep


def _find_excess(text: str, *, may_repeat: bool = False) -> str | None:
    """Why a YAML text may not be parsed; None if it may.

    Nesting and aliases make small texts deep or large, and of a key that a mapping gives twice a parser keeps the last
    value in silence. Events are read one by one, without recursion. A parser that builds values recurses, in C without
    a limit.

    Args:
        text: The text.
        may_repeat: Whether a mapping may give a key twice.
    """
    import yaml

    keys: list[set[str] | None] = [None]  # of each open collection; None of a list
    is_value = [False]  # whether the next node of each is the value of a key
    for event in yaml.parse(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader)):
        if isinstance(event, yaml.AliasEvent):
            return f"it has an alias (*{event.anchor}); write the value out"
        if isinstance(event, yaml.CollectionEndEvent):
            keys.pop(), is_value.pop()
        elif isinstance(event, yaml.NodeEvent):
            known = keys[-1]
            if known is not None and not is_value[-1] and isinstance(event, yaml.ScalarEvent):
                if event.value in known and not may_repeat:
                    return f"line {event.start_mark.line + 1} gives {shown(event.value)} a second time"
                known.add(event.value)
            is_value[-1] = known is not None and not is_value[-1]
            if isinstance(event, yaml.CollectionStartEvent):
                keys.append(set() if isinstance(event, yaml.MappingStartEvent) else None)
                is_value.append(False)
                if len(keys) - 1 > DEEPEST:
                    return f"it is nested more than {DEEPEST} levels deep"
    return None
