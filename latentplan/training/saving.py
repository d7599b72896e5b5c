"""The callbacks of a training run that save, restore, guard and stop it."""

from __future__ import annotations

import copy
import shutil
import time
import warnings
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lightning
import torch

from latentplan.agents.checkpoint import save_checkpoint
from latentplan.config import Config, UserError
from latentplan.config.checks import EnvironmentFault
from latentplan.config.commit import PART, Saves
from latentplan.config.files import dump_config
from latentplan.config.manifest import Extent
from latentplan.config.run_folder import CHECKPOINTS, RUN_FILE
from latentplan.config.run_results import METRICS_FILE
from latentplan.models import WorldModel
from latentplan.replay.buffer import write_saved
from latentplan.replay.disk import ReplayFiles
from latentplan.training.callbacks import Collect, agree_on_signals
from latentplan.training.collection.episodes import to_tensors
from latentplan.training.learner.optimization import load_optimizer_state, return_freed_memory
from latentplan.training.learner.skips import LONGEST_STREAK, NotFiniteError
from latentplan.training.ranks import ALONE, Ranks
from latentplan.training.signals import Signals
from latentplan.training.state import RunState, SavedRun, memory_file, write_state

if TYPE_CHECKING:
    from latentplan.training.learner.module import Learner

SAVE_MINUTES = 5.0
SAVE_SHARE = 0.01  # timed saves take at most this share of the time
SKIPPED_FOLDER = "skipped"
KEPT_BATCHES = 10


def name_save(error: Exception, folder: Path) -> Exception:
    """The error that ended a run which has been saved; the line that a user reads names the folder of the run."""
    if isinstance(error, EnvironmentFault):
        return EnvironmentFault(f"{error}; the run is saved in {folder}", error.origin)
    return UserError(f"{error}; the run is saved in {folder}") if isinstance(error, UserError) else error


class Save(lightning.Callback):
    """Saves the last agent, the best agent, and the state from which a run resumes.

    Where several ranks learn together, all call every method at the same time. A save then holds the replay and the
    collector of each rank; rank 0 writes everything else, which is the same on all ranks.

    Args:
        folder: Folder of the run.
        config: Settings of the run.
        collect: Source of the evaluated weights, of the worker's requests and of the collector's state.
        state: Clocks and evaluations of the run.
        saves: The saves of the run.
        files: Writes the replay.
        facts: Facts of the run that are saved with every agent.
        optimizers: States that the optimizers were loaded with; saved again if the run ends before its first update.
        ranks: The processes that learn together.
    """

    def __init__(
        self,
        folder: Path,
        config: Config,
        collect: Collect,
        state: RunState,
        saves: Saves,
        files: ReplayFiles,
        facts: dict[str, Any],
        optimizers: list[Any],
        ranks: Ranks = ALONE,
    ) -> None:
        self.ranks = ranks
        self.folder, self.config, self.collect, self.state, self.facts = folder, config, collect, state, facts
        self.saves, self.files = saves, files
        self._loaded_optimizers = optimizers
        self._num_seen_evaluations = len(state.evaluations)
        self._has_evaluated = False
        self._next_minutes = state.minutes + SAVE_MINUTES

    def on_train_epoch_start(self, trainer: lightning.Trainer, learner: Learner) -> None:  # type: ignore[override]
        """Save the agent of an evaluation that has just finished, if it is the best."""
        self._has_evaluated |= self.keep_best(learner)

    def on_train_epoch_end(self, trainer: lightning.Trainer, learner: Learner) -> None:  # type: ignore[override]
        """Save after every evaluation, and some minutes after the last save."""
        if not self.collect.is_epoch_over:
            return
        if self._has_evaluated or self.ranks.largest(self.state.minutes >= self._next_minutes):
            self.save(trainer, learner)

    def keep_best(self, learner: Learner) -> bool:
        """Save the latest evaluated agent if its planner is the best so far.

        Returns:
            Whether an evaluation finished since the last call.
        """
        if len(self.state.evaluations) == self._num_seen_evaluations:
            return False
        self._num_seen_evaluations = len(self.state.evaluations)
        if (latest := self.state.evaluations[-1])["planner"] > self.state.best_return:
            self.state.best_return = latest["planner"]
            evaluated = copy.deepcopy(learner.averaged)
            weights = self.collect.evaluated_weights
            evaluated.load_state_dict({name: torch.from_numpy(value) for name, value in weights.items()})
            self.save_agent("best", evaluated, {name: latest[name] for name in ("env_frames", "updates", "minutes")})
        return True

    def save(self, trainer: lightning.Trainer, learner: Learner) -> None:
        """Save the last agent and the state of the run."""
        started = time.monotonic()
        self.save_agent("last", learner.averaged, self.clocks(learner))
        self.save_run(trainer, learner)
        return_freed_memory()
        self._has_evaluated = False
        pause = max(SAVE_MINUTES, (time.monotonic() - started) / 60.0 / SAVE_SHARE)
        self._next_minutes = self.state.minutes + (pause if SAVE_MINUTES > 0.0 else 0.0)

    def save_run(self, trainer: lightning.Trainer, learner: Learner) -> None:
        """Save the state from which the run resumes."""
        saved = SavedRun(
            self.state,
            {
                "weights": learner.state_dict(),
                "updates": learner.updates,
                "metrics": {name: float(value) for name, value in learner.metrics.items()},
            },
            [optimizer.state_dict() for optimizer in trainer.optimizers] or self._loaded_optimizers,
            to_tensors(self.collect.requests),
            to_tensors(self.collect.memory),
        )
        shares = self.ranks.together(self._write_share)

        def write(part: Path) -> dict[str, Extent]:
            extents = self.files.write(part)
            write_state(saved, part)
            dump_config(self.config, part / RUN_FILE)
            if (self.folder / METRICS_FILE).exists():
                shutil.copyfile(self.folder / METRICS_FILE, part / METRICS_FILE)
            for rank, share in enumerate(shares):
                extents |= share
                for path in [] if rank == 0 else [*self._share_folder(rank).iterdir()]:
                    path.rename(part / path.name)
            return extents

        self.ranks.lead(lambda: self.saves.commit(write, self.clocks(learner)))
        shutil.rmtree(self._share_folder(self.ranks.rank), ignore_errors=True)

    def _write_share(self) -> dict[str, Extent]:
        """Writes replay and collector of a rank above 0 beside the saves; returns the committed part of each log."""
        if self.ranks.is_first:
            return {}
        folder = self._share_folder(self.ranks.rank)
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        write_saved({"memory": to_tensors(self.collect.memory)}, folder / memory_file(self.ranks.rank))
        return self.files.write(folder)

    def _share_folder(self, rank: int) -> Path:
        return self.saves.folder / f"rank-{rank}{PART}"

    def save_agent(self, name: str, model: WorldModel, info: dict[str, Any]) -> None:
        """Save an agent in `checkpoints/<name>`, with the facts in `info` and the facts of the run."""
        self.ranks.lead(lambda: self._save_agent(name, model, info))

    def _save_agent(self, name: str, model: WorldModel, info: dict[str, Any]) -> None:
        facts = self.facts | info | {"metrics": self.state.evaluations}
        planner = self.config.planner
        if planner.use_continues is None:
            memory = self.collect.memory  # the collector remembers an end that the replay has overwritten
            has_seen_end = bool(memory and memory["has_seen_end"]) or self.files.replay.has_recorded_end
            planner = replace(planner, use_continues=has_seen_end)
        save_checkpoint(self.folder / CHECKPOINTS / name, model, replace(self.config, planner=planner), facts)

    def clocks(self, learner: Learner) -> dict[str, Any]:
        """The frames, updates and minutes of the present agent."""
        return {"env_frames": self.state.env_frames, "updates": learner.updates, "minutes": self.state.minutes}


class Restore(lightning.Callback):
    """Loads saved states into the optimizers of a resumed run.

    Args:
        optimizers: One saved state per optimizer; empty for a new run.
    """

    def __init__(self, optimizers: list[Any]) -> None:
        self.optimizers = optimizers

    def on_fit_start(self, trainer: lightning.Trainer, learner: lightning.LightningModule) -> None:
        """Load the saved states, after Lightning has made the optimizers."""
        for optimizer, saved in zip(trainer.optimizers, self.optimizers, strict=True) if self.optimizers else ():
            load_optimizer_state(optimizer, saved)


class Guard(lightning.Callback):
    """Keeps batches whose steps were skipped, and ends a run in which too many steps in a row were skipped.

    A GPU is asked at the end of an epoch only, because it would have to wait. Then the last batch of the epoch that was
    skipped is kept.

    Args:
        folder: Folder of the run; batches are kept in `skipped/` there, at most 10. A rank above 0 keeps its shares of
            them in a folder below.
        ranks: The processes that learn together.
    """

    def __init__(self, folder: Path, ranks: Ranks = ALONE) -> None:
        self.folder = folder / SKIPPED_FOLDER
        if not ranks.is_first:
            self.folder /= f"rank-{ranks.rank}"
        self._seen = [0, 0]

    def on_train_start(self, trainer: lightning.Trainer, learner: Learner) -> None:  # type: ignore[override]
        """Count from the steps that were skipped before."""
        self._seen = [int(half.total) for half in learner.skips]

    def on_train_batch_end(self, trainer: lightning.Trainer, learner: Learner, *_: Any) -> None:  # type: ignore[override]
        """Check the latest update, on a CPU."""
        if learner.device.type == "cpu":
            self.check(learner)

    def on_train_epoch_end(self, trainer: lightning.Trainer, learner: Learner) -> None:  # type: ignore[override]
        """Check all updates since the last check."""
        self.check(learner)

    def check(self, learner: Learner) -> None:
        """Keep the batch of a skipped step.

        Raises:
            NotFiniteError: Ten steps in a row were skipped.
        """
        for half, name in enumerate(("model", "behaviour")):
            skips = learner.skips[half]
            if (total := int(skips.total)) == self._seen[half]:
                continue
            self._seen[half] = total
            self._keep(learner, name, skips.rows)
            if int(skips.longest) >= LONGEST_STREAK:
                raise NotFiniteError(
                    f"the loss or gradient of the {name} was not finite in {LONGEST_STREAK} steps in a row, up to "
                    f"update {learner.updates}; batches are kept in {self.folder}; a lower learning rate may help",
                    learner.updates,
                )

    def _keep(self, learner: Learner, name: str, rows: torch.Tensor) -> None:
        """Keep a batch and warn; after some batches a run only counts, because one reason would fill its log."""
        path = self.folder / f"{name}-{learner.updates:09d}.pt"
        if path.exists() or len(list(self.folder.glob("*.pt"))) >= KEPT_BATCHES:
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        batch = learner.replay.gather(rows.to(learner.replay.device))
        write_saved({part: value.cpu() for part, value in batch._asdict().items()}, path)
        warnings.warn(
            f"the loss or gradient of the {name} was not finite by update {learner.updates}: a step was skipped, and "
            f"its batch is kept in {path}",
            RuntimeWarning,
            stacklevel=2,
        )


class Stop(lightning.Callback):
    """Ends the run at its budget, or when a signal asks for it.

    Args:
        config: Settings of the run, with its budget.
        state: Clocks of the run, and whether a signal interrupted it.
        signals: Handles signals, also while Lightning runs.
        ranks: The processes that learn together, which stop together.
    """

    def __init__(self, config: Config, state: RunState, signals: Signals, ranks: Ranks = ALONE) -> None:
        self.run, self.state, self.signals, self.ranks = config.run, state, signals, ranks

    def on_train_start(self, trainer: lightning.Trainer, learner: lightning.LightningModule) -> None:
        """Handle signals in place of Lightning, whose handler would lose the run."""
        self.signals.install()

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: Any) -> None:  # type: ignore[override]
        """Stop between two updates when the minutes are spent or a signal has arrived."""
        agree_on_signals(self.state, self.ranks)
        if self._is_time_spent() or self.state.interrupted:
            trainer.should_stop = True

    def on_train_epoch_end(self, trainer: lightning.Trainer, learner: Learner) -> None:  # type: ignore[override]
        """Stop after the epoch that learned from the last round."""
        agree_on_signals(self.state, self.ranks)
        if self.state.interrupted or self.is_spent(learner):
            trainer.should_stop = True

    def is_spent(self, learner: Learner) -> bool:
        """Whether minutes or updates are used up, or the frames are and the learner has learned from all of them."""
        frames, updates, state = self.run.frames, self.run.updates, self.state
        if updates is not None and learner.updates >= updates:
            return True
        has_learned = not state.in_epoch and state.learned_rounds == state.rounds
        return self._is_time_spent() or (frames is not None and state.env_frames >= frames and has_learned)

    def _is_time_spent(self) -> bool:
        return self.run.minutes is not None and bool(self.ranks.largest(self.state.minutes >= self.run.minutes))
