"""Files that are replaced as a whole."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def replaced_whole(path: Path) -> Iterator[Path]:
    """A path beside `path` to write to, which takes the name of `path` when the block ends.

    Readers therefore never see a file that is half written. A block that raises leaves `path` as it was.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def write_whole(path: Path, text: str) -> Path:
    """Writes a text in place of a file, in UTF-8 and with line ends as they are; returns the path."""
    with replaced_whole(path) as part:
        part.write_text(text, encoding="utf-8", newline="")
    return path
