"""Files that are replaced as a whole."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def replaced_whole(path: Path) -> Iterator[Path]:
    """A path beside `path` to write to, which takes the name of `path` when the block ends.

    Readers therefore never see a file that is half written. A block that raises leaves `path` as it was. A process that
    is killed leaves the path beside; see `remove_parts`.
    """
    part = part_of(path)
    part.unlink(missing_ok=True)
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def part_of(path: Path) -> Path:
    """The path beside a file to which this process writes before it replaces the file."""
    return path.with_name(f".{path.name}.{os.getpid()}")


def remove_parts(path: Path) -> None:
    """Removes what killed processes left beside a file while they replaced it; parts of running processes stay.

    The calling process itself must not be replacing the file.
    """
    for part in path.parent.glob(f".{path.name}.*"):
        process = int(part.suffix[1:]) if re.fullmatch(r"\.[1-9][0-9]{0,8}", part.suffix) else None
        if process is not None and (process == os.getpid() or not _is_running(process)):
            part.unlink(missing_ok=True)


def write_whole(path: Path, text: str) -> Path:
    """Writes a text in place of a file, in UTF-8 and with line ends as they are; returns the path."""
    with replaced_whole(path) as part:
        part.write_text(text, encoding="utf-8", newline="")
    return path


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True  # the process of another user
    return True
