"""The state of a run (clocks, evaluations, weights, optimizers), saved and loaded."""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from latentplan.agents.checkpoint import INFO
from latentplan.config import UserError
from latentplan.config.commit import Save, Saves
from latentplan.config.manifest import DamageError, Extent, write_synced
from latentplan.config.run_folder import RUN_FILE, SAVES_FOLDER
from latentplan.config.run_results import METRICS_FILE
from latentplan.config.writing import replaced_whole
from latentplan.replay.buffer import read_saved
from latentplan.replay.dealing import count_ranks
from latentplan.training.ranks import Ranks

if TYPE_CHECKING:
    from latentplan.training.learner.module import Learner


CONTENTS = {RUN_FILE: "a run", INFO: "an agent", f"{SAVES_FOLDER}/save-*[0-9]": "an agent"}
STATE_FILE = "state.pt"


@dataclass
class RunState:
    """The clocks of a run and the results of its evaluations.

    Attributes:
        env_frames: Simulator control steps so far.
        decisions: Decisions so far.
        rounds: Collection rounds so far.
        learned_rounds: Value of `rounds` when the last epoch ended; -1 before the first epoch.
        in_epoch: Whether an epoch has begun and not ended.
        epoch_updates: Updates so far in this epoch.
        earlier_minutes: Wall-clock minutes that the run had taken by `started`.
        next_evaluation: Value of `env_frames` at which the next evaluation is due.
        best_return: Best mean return of the planner in an evaluation so far.
        evaluations: One entry per evaluation: env_frames, decisions, updates, minutes, planner, actor.
        episode_returns: Returns of collected episodes that no row of metrics has counted yet.
        curriculum_over: Whether the value head was reset after the curriculum's task.
        worker_restarts: Collection processes that ended and were replaced.
        interrupted: Number of the signal that asked to stop, on which all processes that learn together have agreed; 0
            without one.
        received: Number of the signal that this process has received; 0 without one.
        started: Time from which `minutes` counts on, in seconds of the monotonic clock of this process.
    """

    env_frames: int = 0
    decisions: int = 0
    rounds: int = 0
    learned_rounds: int = -1
    in_epoch: bool = False
    epoch_updates: int = 0
    earlier_minutes: float = 0.0
    next_evaluation: int = 0
    best_return: float = float("-inf")
    evaluations: list[dict[str, Any]] = field(default_factory=list)
    episode_returns: list[float] = field(default_factory=list)
    curriculum_over: bool = False
    worker_restarts: int = 0
    interrupted: int = 0
    received: int = 0
    started: float = field(default_factory=time.monotonic)

    @property
    def minutes(self) -> float:
        """Wall-clock minutes of the run, over all its processes."""
        return self.earlier_minutes + (time.monotonic() - self.started) / 60.0

    def set_minutes(self, minutes: float) -> None:
        """Set the wall clock back to `minutes`, so that the time since then does not count."""
        self.earlier_minutes, self.started = minutes, time.monotonic()

    def to_dict(self) -> dict[str, Any]:
        """The fields that are saved: all but `started`, `interrupted` and `received`, which belong to this process."""
        values = asdict(self) | {"earlier_minutes": self.minutes}
        return {name: value for name, value in values.items() if name not in ("interrupted", "received", "started")}


@dataclass(frozen=True)
class SavedRun:
    """What a save holds beside the replay, the settings and the metrics.

    Attributes:
        state: Clocks and evaluations.
        learner: The learner's `weights` (with its counts of skipped steps), number of `updates` and latest `metrics`.
        optimizers: One state per optimizer; empty before the first update.
        requests: What the worker was asked for and has not answered; see `Collect`.
        memory: State of the collector after the last round that was stored; None before the first.
        has_seen_end: Whether a collector has seen an episode end in a terminal state; known for a run that resumes.
    """

    state: RunState
    learner: dict[str, Any]
    optimizers: list[Any]
    requests: dict[str, Any]
    memory: dict[str, Any] | None
    has_seen_end: bool = False


def write_state(saved: SavedRun, part: Path) -> None:
    """Writes a run's state into the folder of a save."""
    values = {name: getattr(saved, name) for name in ("learner", "optimizers", "requests", "memory")}
    torch.save({"run": saved.state.to_dict(), **values}, part / STATE_FILE)


def memory_file(rank: int) -> str:
    """Name of the file with the collector's state of a rank above 0; that of rank 0 is in `STATE_FILE`."""
    return f"collector-{rank}.pt"


def read_memory(save: Save, rank: int) -> dict[str, Any] | None:
    """The collector's state that a rank above 0 saved; None before its first round."""
    memory: dict[str, Any] | None = read_saved(save.folder / memory_file(rank), keys=("memory",))["memory"]
    return memory


def read_state(save: Save) -> SavedRun:
    """The state that `write_state` wrote, with its tensors on the CPU.

    Raises:
        DamageError: The state has other entries, or values outside of their ranges.
    """
    path = save.folder / STATE_FILE
    saved = read_saved(path, keys=("run", "learner", "optimizers", "requests", "memory"))
    try:
        state = RunState(**saved.pop("run"))
        counts = ("env_frames", "decisions", "rounds", "epoch_updates", "next_evaluation", "worker_restarts")
        for name in counts:
            value = getattr(state, name)
            if not isinstance(value, int) or value < 0:
                raise ValueError(f"{name} is {value!r}")
        return SavedRun(state, **saved)
    except (TypeError, ValueError) as error:
        raise DamageError(f"{path} is damaged: {str(error)[:160]}") from None


def read_saved_run(save: Save, ranks: Ranks) -> SavedRun:
    """What one rank resumes from: the state, with its own collector's memory; None of another number of ranks.

    Raises:
        DamageError: The state has other entries, or values outside of their ranges.
    """
    saved = read_state(save)
    memories = [saved.memory, *(read_memory(save, rank) for rank in range(1, count_ranks(save)))]
    has_seen_end = any(memory is not None and bool(memory["has_seen_end"]) for memory in memories)
    memory = memories[ranks.rank] if len(memories) == ranks.size else None
    return replace(saved, memory=memory, has_seen_end=has_seen_end)


def save_values(saves: Saves, values: dict[str, Any], note: Mapping[str, Any]) -> None:
    """Saves tensors and plain values as one commit; `load_values` restores them."""

    def write(part: Path) -> dict[str, Extent]:
        torch.save(values, part / STATE_FILE)
        return {}

    saves.commit(write, note)


def load_values(saves: Saves, keys: Sequence[str]) -> dict[str, Any]:
    """The values of the newest save that is whole; a warning names newer ones that are not.

    Args:
        saves: The saves.
        keys: Names that the values must have.

    Raises:
        UserError: There is no save, or none is whole.
    """
    save, problems = saves.newest()
    warn_of_loss(save, problems)
    values: dict[str, Any] = read_saved(save.folder / STATE_FILE, keys=keys)
    return values


def warn_of_loss(save: Save, problems: Sequence[str]) -> None:
    """Warn of saves that are damaged, and say what the save that takes their place holds."""
    clocks = ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in save.note.items())
    for problem in problems:
        warnings.warn(
            f"{problem}: the save before takes its place ({clocks}); what was done after it is lost, and is done again",
            RuntimeWarning,
            stacklevel=3,
        )


def restore_learner(learner: Learner, saved: dict[str, Any], folder: Path) -> None:
    """Loads a saved state into a learner.

    Args:
        learner: The learner to load into.
        saved: `SavedRun.learner`.
        folder: Folder of the run, for the error message.

    Raises:
        UserError: The saved weights have other names or shapes than this model.
    """
    try:
        learner.load_state_dict(saved["weights"])
    except RuntimeError as error:
        reason = str(error).splitlines()[-1].strip()
        raise UserError(f"the saved weights in {folder} do not fit the settings in its config.yaml: {reason}") from None
    learner.updates = saved["updates"]
    learner.metrics = {name: torch.tensor(value) for name, value in saved["metrics"].items()}


def restore_metrics(save: Save, folder: Path) -> None:
    """Puts the rows of metrics of a save in place of those that the run has written since."""
    path = folder / METRICS_FILE
    if not (save.folder / METRICS_FILE).exists():
        path.unlink(missing_ok=True)
        return
    with replaced_whole(path) as part:
        write_synced(part, (save.folder / METRICS_FILE).read_bytes())


def refuse_used(folder: Path, kind: str, flag: str) -> None:
    """Refuses a folder that already holds a run or an agent.

    Args:
        folder: Where a new run or agent is about to be written.
        kind: Kind of saves from which the caller can resume; if there are any, the message names `--resume`.
        flag: The flag that chooses another folder.

    Raises:
        UserError: The folder holds something that `CONTENTS` describes.
    """
    for pattern, content in CONTENTS.items():
        if any(folder.glob(pattern)):
            can_resume = Saves(folder / SAVES_FOLDER, kind, 0).kinds() == {kind}
            advice = f"resume it with --resume {folder} (or from Python), or " if can_resume else ""
            raise UserError(f"{folder} already holds {content}: {advice}choose another {flag}")
