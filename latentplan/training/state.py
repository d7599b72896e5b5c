"""The state of a run (clocks, evaluations, weights, optimizers), saved and loaded, and the lock of its folder."""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from latentplan.agents.checkpoint import INFO
from latentplan.config import UserError, make_folder
from latentplan.replay.buffer import Replay, read_saved

if TYPE_CHECKING:
    from latentplan.training.learner.module import Learner


LOCK_FILE = ".lock"
RUN_FILE = "config.yaml"
GOALS_FILE = "goals.pt"
DISTILLATION_FILE = Path("resume") / "distill.pt"
CONTENTS = {RUN_FILE: "a run", INFO: "an agent", GOALS_FILE: "an agent", str(DISTILLATION_FILE): "an agent"}
STATE_FILE = "state.pt"
INTERRUPTED = 130  # exit code of a run that the user ended


@dataclass
class RunState:
    """The clocks of a run and the results of its evaluations.

    Attributes:
        env_frames: Simulator control steps so far.
        decisions: Decisions so far.
        rounds: Collection rounds so far.
        learned_rounds: Value of `rounds` when the last epoch ended; -1 before the first epoch.
        earlier_minutes: Wall-clock minutes that the run had taken by `started`.
        next_evaluation: Value of `env_frames` at which the next evaluation is due.
        best_return: Best mean return of the planner in an evaluation so far.
        evaluations: One entry per evaluation: env_frames, decisions, updates, minutes, planner, actor.
        curriculum_over: Whether the value head was reset after the curriculum's task.
        interrupted: Whether the user asked to stop.
        started: Time from which `minutes` counts on, in seconds of the monotonic clock of this process.
    """

    env_frames: int = 0
    decisions: int = 0
    rounds: int = 0
    learned_rounds: int = -1
    earlier_minutes: float = 0.0
    next_evaluation: int = 0
    best_return: float = float("-inf")
    evaluations: list[dict[str, Any]] = field(default_factory=list)
    curriculum_over: bool = False
    interrupted: bool = False
    started: float = field(default_factory=time.monotonic)

    @property
    def minutes(self) -> float:
        """Wall-clock minutes of the run, over all its processes."""
        return self.earlier_minutes + (time.monotonic() - self.started) / 60.0

    def set_minutes(self, minutes: float) -> None:
        """Set the wall clock back to `minutes`, so that the time since then does not count."""
        self.earlier_minutes, self.started = minutes, time.monotonic()

    def to_dict(self) -> dict[str, Any]:
        """The fields that are saved: all but `started` and `interrupted`, which belong to this process."""
        values = asdict(self) | {"earlier_minutes": self.minutes}
        return {name: value for name, value in values.items() if name not in ("interrupted", "started")}


def save_state(folder: Path, state: RunState, learner: dict[str, Any], optimizers: list[Any], replay: Replay) -> None:
    """Saves a run so that `load_state` can resume it; replaces the state file in one step, after the replay.

    Args:
        folder: Folder of the saved state.
        state: Clocks and evaluations.
        learner: The learner's `weights` and number of `updates`.
        optimizers: One state per optimizer.
        replay: The replay; its new rows are appended to the saved ones.
    """
    replay.save(folder / "replay")
    save_atomically({"run": state.to_dict(), "learner": learner, "optimizers": optimizers}, folder / STATE_FILE)


def save_atomically(saved: dict[str, Any], path: Path) -> None:
    """Writes a file with `torch.save`; an earlier file stays whole until the new one replaces it in one step."""
    make_folder(path.parent)
    part = path.with_name(f"{path.name}.part")
    torch.save(saved, part)
    part.replace(path)


def load_state(folder: Path, device: torch.device) -> tuple[RunState, dict[str, Any], list[Any]]:
    """Loads the clocks, the learner's state and the optimizers' states that `save_state` wrote.

    Raises:
        UserError: The folder holds no saved run, or a damaged one.
    """
    if not (folder / STATE_FILE).exists():
        raise UserError(f"nothing to resume in {folder.parent}: {folder / STATE_FILE} is missing")
    saved = read_saved(folder / STATE_FILE, device, ("run", "learner", "optimizers"))
    try:
        return RunState(**saved["run"]), saved["learner"], saved["optimizers"]
    except TypeError as error:
        raise UserError(f"{folder / STATE_FILE} is damaged: {error}") from None


def restore_learner(learner: Learner, saved: dict[str, Any], folder: Path) -> None:
    """Loads a saved state into a learner.

    A run saved before averaged weights existed starts its average from the saved weights.

    Args:
        learner: The learner to load into.
        saved: The saved `weights` and number of `updates`.
        folder: Folder of the run, for the error message.

    Raises:
        UserError: The saved weights have other names or shapes than this model.
    """
    weights = saved["weights"]
    averaged = {f"averaged.{name[6:]}": value for name, value in weights.items() if name.startswith("model.")}
    try:
        learner.load_state_dict({"averaged_updates": learner.averaged_updates, **averaged, **weights})
    except RuntimeError as error:
        reason = str(error).splitlines()[-1].strip()
        raise UserError(f"the saved weights in {folder} do not fit the settings in its config.yaml: {reason}") from None
    learner.updates = saved["updates"]


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
