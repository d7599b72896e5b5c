"""Where a run stands, and how it is written down and picked up again."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from latentplan.config import UserError
from latentplan.replay.buffer import Replay, read_saved

if TYPE_CHECKING:
    from latentplan.training.learner.module import Learner

STATE_FILE = "state.pt"
INTERRUPTED = 130  # exit code of a run that the user ended


@dataclass
class RunState:
    """The clocks of a run and what its evaluations found.

    Attributes:
        env_frames: Simulator control steps so far.
        decisions: Decisions so far.
        rounds: Collections so far.
        learned_rounds: How many of them there were when an epoch last ended; -1 before the first.
        earlier_minutes: Wall clock spent before this process took over.
        next_evaluation: Value of `env_frames` at which the next evaluation is due.
        best_return: Best mean return of the planner so far.
        evaluations: One entry per evaluation: env_frames, updates, minutes, planner, actor.
        curriculum_over: Whether the values of the curriculum's task have been forgotten.
        interrupted: Whether the user asked to stop.
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
        """Wall clock of the run, over all its processes."""
        return self.earlier_minutes + (time.monotonic() - self.started) / 60.0

    def stand(self, minutes: float) -> None:
        """Set the wall clock: what was done since is not part of the run."""
        self.earlier_minutes, self.started = minutes, time.monotonic()

    def to_dict(self) -> dict[str, Any]:
        """What is saved: everything but this process's own clock and interruption."""
        values = asdict(self) | {"earlier_minutes": self.minutes}
        return {name: value for name, value in values.items() if name not in ("interrupted", "started")}


def save_state(folder: Path, state: RunState, learner: dict[str, Any], optimizers: list[Any], replay: Replay) -> None:
    """Write everything that `load_state` needs to go on; the state file is replaced whole, after the replay."""
    replay.save(folder / "replay")
    part = folder / f"{STATE_FILE}.part"
    torch.save({"run": state.to_dict(), "learner": learner, "optimizers": optimizers}, part)
    part.replace(folder / STATE_FILE)


def load_state(folder: Path, device: torch.device) -> tuple[RunState, dict[str, Any], list[Any]]:
    """The clocks, the learner's state and the optimizers' states that `save_state` wrote.

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


def restore(learner: Learner, saved: dict[str, Any], folder: Path) -> None:
    """Put a learner where `save_state` found it; one saved before weights were averaged begins its average there.

    Raises:
        UserError: The weights are not those of this model.
    """
    weights = saved["weights"]
    averaged = {f"averaged.{name[6:]}": value for name, value in weights.items() if name.startswith("model.")}
    try:
        learner.load_state_dict({"averaged_updates": learner.averaged_updates, **averaged, **weights})
    except RuntimeError as error:
        reason = str(error).splitlines()[-1].strip()
        raise UserError(f"what {folder} holds does not fit the settings in its config.yaml: {reason}") from None
    learner.updates = saved["updates"]
