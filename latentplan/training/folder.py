"""The folder of a run: refusal of folders in use, and a lock while a process learns in the folder."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

from latentplan.agents.checkpoint import INFO
from latentplan.config import UserError, make_folder

LOCK_FILE = ".lock"
RUN_FILE = "config.yaml"
GOALS_FILE = "goals.pt"
DISTILLATION_FILE = Path("resume") / "distill.pt"
CONTENTS = {RUN_FILE: "a run", INFO: "an agent", GOALS_FILE: "an agent", str(DISTILLATION_FILE): "an agent"}


def refuse_used(folder: Path, own_file: str, flag: str) -> None:
    """Refuses a folder that already holds a run or an agent.

    Args:
        folder: Where a new run or agent is about to be written.
        own_file: The file in `CONTENTS` from which the caller can resume; if it exists, the message names `--resume`.
        flag: The flag that chooses another folder.

    Raises:
        UserError: The folder holds one of the files in `CONTENTS`.
    """
    for name, content in CONTENTS.items():
        if (folder / name).exists():
            can_resume = (folder / own_file).exists()
            advice = f"resume it with --resume {folder} (or from Python), or " if can_resume else ""
            raise UserError(f"{folder} already holds {content}: {advice}choose another {flag}")


@contextlib.contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Makes a folder if needed, and locks it until the context or the process ends.

    On a file system without locks the folder stays unlocked.

    Raises:
        UserError: Another process holds the lock, or the folder cannot be made.
    """
    make_folder(folder)
    try:
        lock = os.open(folder / LOCK_FILE, os.O_RDWR | os.O_CREAT, 0o666)
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
