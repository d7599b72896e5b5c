"""Checks that settings share, the error that users see, derived seeds, and checks of files to be written."""

from __future__ import annotations

import difflib
import hashlib
import os
import re
import reprlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from latentplan.config.writing import part_of

MAX_THREADS = 1024  # more threads would exhaust the machine
MAX_EPISODES = 1_000_000
SHOWN = 60  # characters of a wrong value that an error repeats
LONGEST_WORD = 200  # characters without a space that an error repeats, such as a path
LONGEST_LINE = 1000  # a longer message repeats input, and is cut to `LONGEST_WORD`


class UserError(ValueError):
    """A mistake of the user; the message is one line that says what to give instead.

    A message has at most 1,000 characters, and no word in it more than 200: of a longer word, such as a path without
    spaces, and of a longer message the beginning and the end are kept, 200 characters in all; see `cut`.
    """

    def __init__(self, message: object = "") -> None:
        super().__init__(cut(str(message)))


class EnvironmentFault(UserError):
    """An environment that failed; the traceback of the environment's own code is in `__notes__`.

    Attributes:
        origin: Traceback of the environment's process as text, empty where there is none.
    """

    def __init__(self, message: object = "", origin: str = "") -> None:
        super().__init__(message)
        self.origin = origin
        if origin:
            self.add_note(origin)


def cut(message: str) -> str:
    """A message without the middle of its long words; a message that is long all the same keeps 200 characters."""
    if len(message) <= LONGEST_WORD:
        return message
    if len(message) <= LONGEST_LINE**2:  # the search for words takes longer in longer texts
        message = re.sub(rf"\S{{{LONGEST_WORD + 1},}}", lambda word: _without_middle(word[0]), message)
    return message if len(message) <= LONGEST_LINE else _without_middle(message)


def _without_middle(text: str) -> str:
    part = (LONGEST_WORD - 3) // 2
    return f"{text[:part]}...{text[-part:]}"


def shown(value: Any) -> str:
    """A value as an error repeats it: quoted, on one line, at most 63 characters, found in a short time."""
    if isinstance(value, str | bytes):
        value = value[: SHOWN + 1]  # the repr of a long text takes long
    try:
        text = repr(value) if isinstance(value, str | bytes | Path) else _BRIEF.repr(value)
    except ValueError:  # Python refuses to write whole numbers of more than 4,300 digits
        text = f"a number of {value.bit_length() * 0.30103:.0f} digits" if isinstance(value, int) else "long numbers"
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."


def no_text(settings: object, *names: str) -> None:
    """Refuses a text as the value of settings that are tuples of texts, whose letters would be taken one by one.

    Raises:
        ValueError: A value is a text.
    """
    for name in names:
        value = getattr(settings, name)
        if isinstance(value, str):
            raise ValueError(f"{name} must be a tuple such as ({shown(value)},), got the text {shown(value)}")


def nearest(name: object, known: Iterable[str], cutoff: float = 0.5) -> str | None:
    """The known name that is most similar to a name; None where none is similar."""
    found = difflib.get_close_matches(str(name)[:SHOWN], list(known), n=1, cutoff=cutoff)
    return found[0] if found else None


def derive_seed(seed: int, name: str, counter: int = 0) -> int:
    """A seed in [0, 2**31) for the random stream `name` of a run, the same on every machine."""
    digest = hashlib.sha256(f"{seed}/{name}/{counter}".encode()).digest()
    return int.from_bytes(digest[:4], "little") >> 1


def make_folder(path: Path) -> None:
    """Make a folder for results, and the folders above it.

    Raises:
        UserError: The folder cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot make the folder {path}: {error.strerror}; choose another") from None


def output_file(path: Path, flag: str) -> Path:
    """The path of a file to be written, checked before any work is spent on its content.

    Args:
        path: The file; of a link, the file that the link leads to is returned.
        flag: The flag that names the file, for the error.

    Raises:
        UserError: The path is a folder or a device, its folder does not exist, or nothing can be written there.
    """
    import tempfile  # imported here because every command imports this module, and few write files

    given = str(path)
    _check_name(path, flag, given)
    if path.is_symlink():  # the link stays and its target is replaced
        path = Path(os.path.realpath(path))
        if path.is_symlink() or not path.parent.is_dir():
            raise UserError(f"{flag} {given!r} is a link that leads nowhere; give another name")
    folder = path.parent
    if path.is_dir():
        raise UserError(f"{flag} {given!r} is a folder; give a file in it")
    if path.exists() and not path.is_file():
        raise UserError(f"{flag} {given!r} is not a regular file; give another name")
    if not folder.is_dir():
        existing = next(parent for parent in folder.parents if parent.is_dir())
        raise UserError(f"{flag}: there is no folder {str(folder)!r}; the nearest that exists is {str(existing)!r}")
    _check_name(part_of(path), flag, given)  # the file is first written under this longer name
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise UserError(f"{flag}: cannot write in {str(folder)!r}: {error.strerror}; choose another folder") from None
    return path


def is_utf8(text: str) -> bool:
    """Whether a text has an encoding in UTF-8; the name of a file whose bytes are no UTF-8 has none."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _check_name(path: Path, flag: str, given: str) -> None:
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        pass
    except OSError as error:  # such as a name that is too long
        raise UserError(f"{flag} {given!r} cannot be written: {error.strerror}; give another name") from None


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


def one_of(config: Any, **choices: tuple[str | None, ...]) -> None:
    """Require fields to be one of the values allowed."""
    for name, allowed in choices.items():
        words = ", ".join("null" if choice is None else choice for choice in allowed)
        _require(config, name, getattr(config, name) in allowed, f"one of {words}")


def _require(config: Any, name: str, holds: bool, allowed: str) -> None:
    if not holds:
        raise ValueError(f"{name} must be {allowed}, got {shown(getattr(config, name))}")


_BRIEF = reprlib.Repr()
_BRIEF.maxlevel, _BRIEF.maxstring, _BRIEF.maxother, _BRIEF.maxlong = 3, SHOWN, SHOWN + 1, SHOWN + 1
