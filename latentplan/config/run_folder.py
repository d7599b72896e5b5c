"""The settings, the saves and the lock in the folder of a run."""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from collections.abc import Iterator
from pathlib import Path

from latentplan.config.checks import UserError, make_folder
from latentplan.config.commit import Saves
from latentplan.config.files import SECTIONS, read_config, read_layer
from latentplan.config.manifest import LOGS
from latentplan.config.reading import LARGEST_SETTINGS, read_bytes
from latentplan.config.settings import Config

RUN_FILE = "config.yaml"
LOCK_FILE = ".lock"
SAVES_FOLDER = "resume"
CHECKPOINTS = "checkpoints"
_FOLDERS = (  # in which a run writes and removes files
    *(SAVES_FOLDER, f"{SAVES_FOLDER}/{LOGS}", CHECKPOINTS, f"{CHECKPOINTS}/best", f"{CHECKPOINTS}/last"),
    *("videos", "skipped", "replay", f"replay/{LOGS}"),
)
RUN_FORMAT = 3  # 1 was `resume/state.pt`, from which a run could not continue exactly; 2 kept other counts
RUN, DISTILLATION, GOALS = "run", "distillation", "goals"  # kinds of saves
RESUMED_BY = {  # by kind: what the saves hold, and the command that continues it
    RUN: ("a training run", "train"),
    DISTILLATION: ("a distillation", "distill"),
    GOALS: ("learned goals", "goals"),
}


def run_saves(folder: Path) -> Saves:
    """The saves of a run.

    Raises:
        UserError: The run was saved in the format of an earlier version.
    """
    saves = Saves(folder / SAVES_FOLDER, RUN, RUN_FORMAT)
    if (folder / SAVES_FOLDER / "state.pt").exists() and not saves.exist():
        raise UserError(
            f"{folder} was saved by latentplan 0.2.0 or earlier, from whose saves a run does not continue exactly: "
            "finish it with that version, or start a new run; its agents in checkpoints/ load as before"
        )
    return saves


def require_saves(folder: Path, kind: str) -> None:
    """Refuses a folder from which nothing can be resumed.

    Args:
        folder: The folder.
        kind: What was saved, one of `RESUMED_BY`.

    Raises:
        UserError: The folder holds no save, or saves of another kind alone.
    """
    saves = Saves(folder / SAVES_FOLDER, kind, 0)
    if not saves.exist():
        raise UserError(
            f"nothing to resume in {folder}: {folder / SAVES_FOLDER} holds no save; what latentplan 0.2.0 or earlier "
            "saved is continued by that version"
        )
    kinds = saves.kinds()
    for other, (content, command) in RESUMED_BY.items():
        if other in kinds and kind not in kinds:
            raise UserError(
                f"{folder} holds {content}, not {RESUMED_BY[kind][0]}: continue it with latentplan {command} --resume"
            )


def read_run_config(folder: Path) -> tuple[Config, str | None]:
    """The settings with which a run resumes, and a warning, or None.

    These are the settings in `config.yaml` of the run's folder, which a user may have edited. If the file is missing,
    damaged or cut off, the settings in the last save take its place.

    Raises:
        UserError: The folder holds no run that can be resumed.
    """
    path, copy = folder / RUN_FILE, run_saves(folder).find(RUN_FILE)
    if copy is None:
        require_saves(folder, RUN)
        raise UserError(f"nothing to resume in {folder}: it holds no save of a run that is whole")
    saved = read_config(copy)
    try:
        if read_bytes(path, LARGEST_SETTINGS) == read_bytes(copy, LARGEST_SETTINGS):
            return saved, None
        layer = read_layer(path)
        written = [(section, name) for section, fields in read_layer(copy).items() for name in fields]
        missing = [f"{section}.{name}" for section, name in written if name not in layer.get(section, {})]
        if missing:
            raise UserError(f"{path} lacks {', '.join(missing[:3])}")
        own = read_config(path)  # gives settings that came after the version of the run what they meant then
    except (OSError, ValueError) as error:
        reason = error if isinstance(error, UserError) else f"{path} cannot be read"
        return saved, f"{reason}: the settings of the last save take its place"
    if own.replay.demonstrations != saved.replay.demonstrations:
        raise UserError(
            f"replay.demonstrations in {path} cannot change in a run that resumes, whose recorded episodes are in its "
            f"saves: give {list(saved.replay.demonstrations)} again, or start a new run"
        )
    if saved.collection.enabled and not own.collection.enabled:
        raise UserError(f"collection.enabled in {path} cannot become false in a run that resumes: start a new run")
    changes = [
        f"{section}.{name} from {before!r} to {after!r}"
        for section in SECTIONS
        for name, before in vars(getattr(saved, section)).items()
        if (after := getattr(getattr(own, section), name)) != before
    ]
    what = ", ".join(changes) or "nothing that counts"
    return own, f"{path} was edited after the last save, or is damaged: the run goes on with a change of {what}"


@contextlib.contextmanager
def lock_folder(folder: Path, holder: str = "another process learns") -> Iterator[None]:
    """Makes a folder if needed, and locks it until the context or the process ends.

    On a file system without locks the folder stays unlocked.

    Args:
        folder: The folder.
        holder: What a process does that holds the lock, for the error.

    Raises:
        UserError: Another process holds the lock, the folder cannot be made, or one of its own folders is a link.
    """
    make_folder(folder)
    for path in (folder / name for name in _FOLDERS):
        if path.is_symlink():
            raise UserError(
                f"{path} is a link, and a run writes below its own folder only: put the folder in its place"
            )
    try:
        lock = os.open(folder / LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
    except OSError as error:
        raise UserError(f"cannot write to {folder}: {error.strerror}; choose another") from None
    try:
        with contextlib.suppress(OSError):
            if not try_lock(lock):
                raise UserError(f"{holder} in {folder}: end it first, or choose another folder")
        yield
    finally:
        os.close(lock)


def try_lock(lock: int) -> bool:
    """Locks an open file; whoever asks whether the file is locked holds it for an instant, so a few tries are made."""
    for pause_s in (0.02, 0.05, 0.0):
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        except BlockingIOError:
            time.sleep(pause_s)
    return False
