"""The state of a run (clocks, evaluations, weights, optimizers), saved and loaded."""

from __future__ import annotations

import math
import time
import typing
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, TypeVar

import torch
from torch import Tensor

from latentplan.agents.files import INFO, WEIGHTS
from latentplan.agents.files import remove_leftovers as remove_agent_leftovers
from latentplan.config import USER_DOMAIN, UserError
from latentplan.config.commit import Save, Saves
from latentplan.config.files import read_config
from latentplan.config.manifest import DamageError, Extent, write_synced
from latentplan.config.parsing import fits, list_settings, take_values
from latentplan.config.run_folder import CHECKPOINTS, RUN, RUN_FILE, SAVES_FOLDER
from latentplan.config.run_results import FINAL_FILE, METRICS_FILE, STATUS_FILE
from latentplan.config.writing import remove_parts, replaced_whole
from latentplan.replay.buffer import read_saved, write_saved
from latentplan.replay.dealing import count_ranks
from latentplan.training.collection.memory import Evaluated, Memory, Requests, Round
from latentplan.training.facts import REPORT_FILE
from latentplan.training.learner.optimization import OptimizerState
from latentplan.training.ranks import Ranks

if TYPE_CHECKING:
    from latentplan.training.learner.module import Learner


CONTENTS = {RUN_FILE: "a run", INFO: "an agent", f"{SAVES_FOLDER}/save-*[0-9]": "an agent"}
STATE_FILE = "state.pt"
Kind = TypeVar("Kind")


class LearnerState(TypedDict):
    """A learner: its weights and counts of skipped steps, number of updates, and latest metrics."""

    weights: dict[str, Tensor]
    updates: int
    metrics: dict[str, float]


SAVED_RUN = {
    "run": dict[str, Any],
    "learner": LearnerState,
    "optimizers": list[OptimizerState],
    "requests": Requests,
    "memory": Memory,
}
"""The types of what `STATE_FILE` holds."""


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
    write_saved({"run": saved.state.to_dict(), **values}, part / STATE_FILE)


def memory_file(rank: int) -> str:
    """Name of the file with the collector's state of a rank above 0; that of rank 0 is in `STATE_FILE`."""
    return f"collector-{rank}.pt"


def read_memory(save: Save, rank: int) -> dict[str, Any] | None:
    """The collector's state that a rank above 0 saved; None before its first round.

    Raises:
        DamageError: The file is damaged, or holds something else.
    """
    memory: dict[str, Any] | None = read_saved(save.folder / memory_file(rank), keys={"memory": Memory})["memory"]
    return memory


def read_state(save: Save) -> SavedRun:
    """The state that `write_state` wrote, with its tensors on the CPU.

    Raises:
        DamageError: The state has other entries, or values outside of their ranges.
    """
    path = save.folder / STATE_FILE
    saved = read_saved(path, keys=SAVED_RUN)
    state = build(RunState, saved["run"], path)
    counts = ("env_frames", "decisions", "rounds", "epoch_updates", "next_evaluation", "worker_restarts")
    are_right = all(getattr(state, name) >= 0 for name in counts) and saved["learner"]["updates"] >= 0
    are_right &= math.isfinite(state.minutes) and state.earlier_minutes >= 0.0 and not math.isnan(state.best_return)
    if not are_right or not fits(state.evaluations, list[Evaluated]):
        raise DamageError(f"{path} is damaged: its clocks or evaluations are outside of their ranges")
    if (asked := saved["requests"]["collect"]) is not None:  # the values are arguments, in this order
        saved["requests"]["collect"] = {name: asked[name] for name in Round.__annotations__}
    return SavedRun(state, **{name: saved[name] for name in SAVED_RUN if name != "run"})


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


def build(kind: type[Kind], values: Any, path: Path) -> Kind:
    """A dataclass of saved values.

    Args:
        kind: The dataclass.
        values: A dictionary of values by field.
        path: The file that holds them, for the error.

    Raises:
        DamageError: A field is unknown, or a value has another type or is not allowed.
    """
    hints = typing.get_type_hints(kind)
    try:
        for name, value in values.items():
            if not fits(value, hints[name]):
                raise ValueError(f"{name} has another form")
        return kind(**values)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise DamageError(f"{path} is damaged: {str(error)[:160]}") from None


def build_settings(kind: type[Kind], values: Mapping[str, Any], path: Path) -> Kind:
    """A dataclass of settings that were saved; the arguments and errors are those of `build`."""
    try:
        return build(kind, take_values(list_settings(kind), values), path)
    except DamageError:
        raise
    except UserError as error:
        raise DamageError(f"{path} is damaged: {error}") from None


def save_values(saves: Saves, values: dict[str, Any], note: Mapping[str, Any]) -> None:
    """Saves tensors and plain values as one commit; `load_values` restores them."""

    def write(part: Path) -> dict[str, Extent]:
        write_saved(values, part / STATE_FILE)
        return {}

    saves.commit(write, note)


def load_values(saves: Saves, keys: Sequence[str] | Mapping[str, Any]) -> dict[str, Any]:
    """The values of the newest save that is whole; a warning names newer ones that are not.

    Args:
        saves: The saves.
        keys: Names that the values must have, and their types in a mapping; see `read_saved`.

    Raises:
        UserError: There is no save, or none is whole, or the values are others.
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


def restore_learner(
    learner: Learner, saved: dict[str, Any], folder: Path, acting: Mapping[str, Tensor] | None = None
) -> None:
    """Loads a saved state into a learner.

    Args:
        learner: The learner to load into.
        saved: `SavedRun.learner`.
        folder: Folder of the run, for the error message.
        acting: Weights that the worker acts with, if it was asked for something; they are compared only.

    Raises:
        UserError: The saved weights have other names or shapes than this model.
    """
    try:
        learner.load_state_dict(saved["weights"])
        if acting is not None and _shapes(acting) != _shapes(learner.averaged.state_dict()):
            raise RuntimeError("the worker acts with weights of other shapes")
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


def remove_leftovers(folder: Path) -> None:
    """Removes what killed processes left in a folder of a run, or of another learning; its lock must be held."""
    Saves(folder / SAVES_FOLDER, "any", 0).remove_leftovers()
    for name in (RUN_FILE, METRICS_FILE, STATUS_FILE, FINAL_FILE, REPORT_FILE):
        remove_parts(folder / name)
    for film in (folder / "videos").glob(".*.webm"):
        film.unlink(missing_ok=True)
    for agent in (folder, *(folder / CHECKPOINTS / name for name in ("best", "last"))):
        remove_agent_leftovers(agent, (WEIGHTS, INFO))


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
            advice = f"choose another {flag}"
            if Saves(folder / SAVES_FOLDER, kind, 0).kinds() == {kind}:
                advice = f"resume it with --resume {folder} (or from Python), or {advice}"
                if kind == RUN and _is_of_users_environment(folder):
                    call = f'latentplan.training.resume("{folder}", make_env=...)'
                    advice = f"resume it with {call}, or choose another run_dir"
            raise UserError(f"{folder} already holds {content}: {advice}")


def _is_of_users_environment(folder: Path) -> bool:
    """Whether the run in a folder learns in an environment that a function of the user makes."""
    try:
        return read_config(folder / RUN_FILE).env.domain == USER_DOMAIN
    except (OSError, UserError):  # a damaged file, which is no reason to say less
        return False


def _shapes(weights: Mapping[str, Tensor]) -> dict[str, torch.Size]:
    return {name: value.shape for name, value in weights.items()}
