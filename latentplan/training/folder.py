"""One learning in one folder at a time: two that save to the same files would ruin both."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

from latentplan.agents.checkpoint import INFO
from latentplan.config import UserError, make_folder
from latentplan.training.distillation.standing import STATE_FILE

LOCK = ".lock"
GOALS_FILE = "goals.pt"
MARKS = {"config.yaml": "a run", INFO: "an agent", GOALS_FILE: "an agent", str(STATE_FILE): "an agent"}


def refuse_used(folder: Path, own: str, flag: str) -> None:
    """Refuses a folder in which something has been learned: its agent would be mistaken for the new one.

    Args:
        folder: Where something new is to go.
        own: The one of `MARKS` from which the same kind of learning can go on.
        flag: What names another folder.

    Raises:
        UserError: There is something.
    """
    for name, what in MARKS.items():
        if (folder / name).exists():
            go_on = f"go on with --resume {folder} (or resume from Python), or " if (folder / own).exists() else ""
            raise UserError(f"{folder} already holds {what}: {go_on}choose another {flag}")


@contextlib.contextmanager
def claim(folder: Path) -> Iterator[None]:
    """Make a folder where needed and hold it against every other claim; let go at the end, however the process ends.

    A file system that knows no locks is trusted.

    Raises:
        UserError: Another process learns there, or the folder cannot be made.
    """
    make_folder(folder)
    try:
        lock = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        raise UserError(f"cannot write to {folder}: {error.strerror}; choose another") from None
    try:
        with contextlib.suppress(OSError):
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise UserError(f"another process learns in {folder}: end it first, or choose another folder") from None
        yield
    finally:
        os.close(lock)
