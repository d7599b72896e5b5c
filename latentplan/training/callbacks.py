"""The callbacks of a training run: collect, evaluate, write metrics, save, restore and stop."""

from __future__ import annotations

import copy
import csv
import signal
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lightning
import numpy as np
import torch

from latentplan.agents.checkpoint import save_checkpoint
from latentplan.config import CollectionConfig, Config, EnvironmentFault
from latentplan.models import WorldModel
from latentplan.replay.buffer import Replay
from latentplan.training.collection.collector import Collected
from latentplan.training.collection.process import Worker
from latentplan.training.learner.optimization import load_optimizer_state
from latentplan.training.state import INTERRUPTED, RunState, save_state

if TYPE_CHECKING:
    from latentplan.training.console import Progress
    from latentplan.training.learner.module import Learner

SAVE_MINUTES = 5.0
CLOCKS = ("env_frames", "decisions", "updates", "minutes")
COLUMNS = (*CLOCKS, "episode_return", "planner_return", "actor_return", "planner_minus_actor")  # the losses follow


class Collect(lightning.Callback):
    """Collects one round of experience per epoch, and evaluates the agent when an evaluation is due.

    This callback requests a round from the worker when an epoch starts, and stores the result when the next epoch
    starts. A worker in another process therefore acts while the learner learns, with the averaged weights that the
    learner had when the epoch started.

    Args:
        config: Settings of the run.
        replay: Stores the collected rows.
        state: Clocks of the run, which this callback advances.
        worker: Collects and evaluates.
        videos: Folder for the films of evaluations.

    Attributes:
        episode_returns: Returns of the episodes that ended since the last row of metrics.
        evaluated_weights: Weights that the latest evaluation measured.
        env_restarts: Environments that were made anew after a fault, since the run was started or resumed.
    """

    def __init__(self, config: Config, replay: Replay, state: RunState, worker: Worker, videos: Path) -> None:
        self.config, self.replay, self.state, self.worker, self.videos = config, replay, state, worker, videos
        self.episode_returns: list[float] = []
        self.env_restarts = 0
        self.evaluated_weights: dict[str, np.ndarray] = {}
        self._pending_evaluation: tuple[dict[str, Any], dict[str, np.ndarray]] | None = None  # its clocks and weights
        self._is_round_pending = False

    def on_train_epoch_start(self, trainer: lightning.Trainer, learner: Learner) -> None:  # type: ignore[override]
        """Store the results that were requested one epoch ago, and request the next round and evaluation."""
        settings, state = self.config.collection, self.state
        while (missing := min(settings.prefill_decisions - state.decisions, self._decisions_left())) > 0:
            self.worker.submit("collect", None, "random", missing, state.rounds)
            self._is_round_pending = True
            self.store_results()
            if state.interrupted:
                trainer.should_stop = True
                return
        weights = copy_weights(learner.averaged)
        has_new_rows = state.rounds != state.learned_rounds  # false when a run was resumed after a finished epoch
        if not (self._is_round_pending or has_new_rows):
            self._request_round(weights)
        self.store_results()
        if state.interrupted:
            return
        self._request_round(weights)
        if self._is_round_pending and state.env_frames >= state.next_evaluation:
            self._request_evaluation(learner.updates, weights)

    def on_train_epoch_end(self, trainer: lightning.Trainer, learner: Learner) -> None:  # type: ignore[override]
        """Make the outstanding behaviour update, before other callbacks read the learner."""
        learner.catch_up()
        if not self.state.interrupted:
            self.state.learned_rounds = self.state.rounds

    def store_results(self) -> None:
        """Wait for the requested round and evaluation, and store their results.

        A signal to the whole process group also ends the worker. An interrupted run therefore drops requests that the
        worker cannot answer; the resumed run makes the same requests again.
        """
        try:
            self._store_results()
        except RuntimeError:
            if not self.state.interrupted:
                raise
            self._is_round_pending, self._pending_evaluation = False, None

    def _store_results(self) -> None:
        if self._is_round_pending:
            fault = self._store_round()
            self._is_round_pending = False
            if fault is not None:
                raise fault
        if self._pending_evaluation is not None:
            returns = self.worker.result()
            clocks, self.evaluated_weights = self._pending_evaluation
            entry = clocks | {mode: float(np.mean(values)) for mode, values in returns.items()}
            self.state.evaluations.append(entry)
            # Set only now, so that a resumed run repeats an evaluation that was interrupted.
            every = self.config.evaluation.every_frames
            self.state.next_evaluation = (entry["env_frames"] // every + 1) * every
            self._pending_evaluation = None

    def _request_round(self, weights: dict[str, np.ndarray]) -> None:
        """Request the next round, if the budget has frames left."""
        settings, state = self.config.collection, self.state
        decisions = min(settings.round_decisions, self._decisions_left())
        if decisions > 0:
            behaviour, goal = choose_behaviour(settings, state.rounds, state.env_frames)
            self.worker.submit("collect", weights, behaviour, decisions, state.rounds, goal)
            self._is_round_pending = True

    def _decisions_left(self) -> int:
        frames = self.config.run.frames
        if frames is None:
            return sys.maxsize
        return -(-(frames - self.state.env_frames) // self.config.env.action_repeat)

    def _request_evaluation(self, updates: int, weights: dict[str, np.ndarray]) -> None:
        state, settings = self.state, self.config.evaluation
        clocks = {"env_frames": state.env_frames, "decisions": state.decisions, "updates": updates}
        self._pending_evaluation = clocks | {"minutes": round(state.minutes, 3)}, weights
        film = self.videos / f"{state.env_frames:09d}.webm" if settings.video else None
        self.worker.submit("evaluate", settings.episodes, film)

    def _store_round(self) -> EnvironmentFault | None:
        """Stores a round, and returns the fault that ended it early."""
        collected: Collected = self.worker.result()
        for lane, rows in enumerate(collected.rows):
            self.replay.add(lane, rows)
        self.state.env_frames += collected.env_frames
        self.state.decisions += collected.decisions
        self.state.rounds += 1
        self.episode_returns.extend(collected.episode_returns)
        self.env_restarts = collected.restarts
        return collected.fault


def copy_weights(model: WorldModel) -> dict[str, np.ndarray]:
    """A copy of a model's state as NumPy arrays, which workers in other processes accept."""
    return {name: value.detach().cpu().numpy().copy() for name, value in model.state_dict().items()}


def choose_behaviour(settings: CollectionConfig, rounds: int, env_frames: int) -> tuple[str, str | None]:
    """Chooses the behaviour of the next collection round, and its goal.

    With `behaviour` "both", planner and actor alternate in the rounds without a goal.

    Args:
        settings: Settings of collection.
        rounds: Rounds collected before.
        env_frames: Simulator frames collected before.

    Returns:
        "planner" or "actor", and the expression that the planner pursues instead of the reward, or None.
    """
    num_goals, share = 0, settings.goal_share
    if share > 0.0 and env_frames >= settings.goals_after:
        num_goals = int(rounds * share)
        if int((rounds + 1) * share) > num_goals:
            return "planner", settings.goals[num_goals % len(settings.goals)]
    if settings.behaviour == "both":
        return ("planner", "actor")[(rounds - num_goals) % 2], None
    return settings.behaviour, None


class MetricsFile:
    """A CSV file whose header grows with the names of its rows.

    The header begins with `columns`; every other name follows in the order in which it was first appended. A row with a
    new name rewrites the file under the longer header: earlier rows keep their figures and stay empty in new columns.

    Args:
        path: The file; it need not exist.
        columns: Names that begin the header of a new file.
    """

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        self.path, self.columns = path, tuple(columns)

    def append(self, row: Mapping[str, float]) -> None:
        """Add one row; columns for which the row has no figure stay empty."""
        header = self._read_header()
        columns = list(dict.fromkeys([*(header or self.columns), *row]))
        if columns != header:
            self._write(columns, self._read_rows())
        with self.path.open("a", newline="") as file:
            csv.DictWriter(file, columns).writerow(row)

    def drop_rows(self, is_dropped: Callable[[dict[str, str]], bool]) -> None:
        """Rewrite the file without some rows, and without a last row that was written only in part."""
        if self.path.exists():
            kept = [row for row in self._read_rows() if not is_dropped(row)]
            self._write(self._read_header() or self.columns, kept)

    def _read_header(self) -> list[str]:
        if not self.path.exists():
            return []
        with self.path.open(newline="") as file:
            return next(csv.reader(file), [])

    def _read_rows(self) -> list[dict[str, str]]:
        if not self.path.exists():
            return []
        with self.path.open(newline="") as file:
            return [row for row in csv.DictReader(file) if None not in row.values()]

    def _write(self, columns: Sequence[str], rows: Iterable[Mapping[str, str]]) -> None:
        part = self.path.with_name(f"{self.path.name}.part")
        with part.open("w", newline="") as file:
            writer = csv.DictWriter(file, columns)
            writer.writeheader()
            writer.writerows(rows)
        part.replace(self.path)


class Record(lightning.Callback):
    """Writes metrics.csv and TensorBoard events once per epoch, and moves the progress display.

    Every entry of `Learner.metrics` becomes a column and a TensorBoard scalar of the same name.

    Args:
        path: Path of metrics.csv.
        state: Clocks and evaluations of the run.
        collect: Source of the returns of collected episodes.
        progress: Display of the run.
    """

    def __init__(self, path: Path, state: RunState, collect: Collect, progress: Progress) -> None:
        self.file, self.state, self.collect, self.progress = MetricsFile(path, COLUMNS), state, collect, progress
        self._num_written_evaluations = len(state.evaluations)

    def on_fit_start(self, trainer: lightning.Trainer, learner: Learner) -> None:  # type: ignore[override]
        """Drop the rows that a killed run wrote after its last save, because the resumed run writes them again."""
        clocks = {"env_frames": self.state.env_frames, "updates": learner.updates}
        self.file.drop_rows(lambda row: any(int(row[name]) > now for name, now in clocks.items()))

    def on_train_batch_end(self, trainer: lightning.Trainer, learner: Learner, *_: Any) -> None:  # type: ignore[override]
        """Update the progress display."""
        self.progress.update(self.state, learner.updates)

    def on_train_epoch_end(self, trainer: lightning.Trainer, learner: Learner) -> None:  # type: ignore[override]
        """Append one row for the epoch, after the rows of finished evaluations."""
        self.write_evaluations(trainer)
        state = self.state
        clocks = {"env_frames": state.env_frames, "decisions": state.decisions, "updates": learner.updates}
        row: dict[str, float] = clocks | {"minutes": round(state.minutes, 3)}
        if self.collect.episode_returns:
            row["episode_return"] = float(np.mean(self.collect.episode_returns))
            self.progress.episode_return = row["episode_return"]
            self.collect.episode_returns.clear()
        for name in sorted(learner.metrics, key=lambda name: name.endswith("_grad_norm")):  # losses, then the norms
            row[name] = float(learner.metrics[name])
        if self.collect.env_restarts:
            row["env_restarts"] = self.collect.env_restarts
        self._append(trainer, row)

    def write_evaluations(self, trainer: lightning.Trainer) -> None:
        """Append one row per new evaluation, with the clocks of the weights that were evaluated."""
        for entry in self.state.evaluations[self._num_written_evaluations :]:
            returns = {"planner_return": entry["planner"], "actor_return": entry["actor"]}
            difference = {"planner_minus_actor": entry["planner"] - entry["actor"]}
            self._append(trainer, {name: entry[name] for name in CLOCKS} | returns | difference)
            self.progress.show_evaluation(entry)
        self._num_written_evaluations = len(self.state.evaluations)

    def _append(self, trainer: lightning.Trainer, row: dict[str, float]) -> None:
        if trainer.logger is not None:
            trainer.logger.log_metrics(row, step=int(row["env_frames"]))
        self.file.append(row)


class Save(lightning.Callback):
    """Saves the last agent, the best agent, and the state from which a run resumes.

    Args:
        folder: Folder of the run.
        config: Settings of the run.
        collect: Source of the evaluated weights and of the replay.
        state: Clocks and evaluations of the run.
        facts: Facts of the run that are saved with every agent.
        optimizers: States that the optimizers were loaded with; saved again if the run ends before its first update.
    """

    def __init__(
        self,
        folder: Path,
        config: Config,
        collect: Collect,
        state: RunState,
        facts: dict[str, Any],
        optimizers: list[Any],
    ) -> None:
        self.folder, self.config, self.collect, self.state, self.facts = folder, config, collect, state, facts
        self._loaded_optimizers = optimizers
        self._num_seen_evaluations = len(state.evaluations)
        self._saved_minutes = state.minutes

    def on_train_epoch_end(self, trainer: lightning.Trainer, learner: Learner) -> None:  # type: ignore[override]
        """Save after every evaluation, and `SAVE_MINUTES` after the last save."""
        if self.keep_best(learner) or self.state.minutes >= self._saved_minutes + SAVE_MINUTES:
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
        self.save_agent("last", learner.averaged, self.clocks(learner))
        self.save_run(trainer, learner)
        self._saved_minutes = self.state.minutes

    def save_run(self, trainer: lightning.Trainer, learner: Learner) -> None:
        """Save the state from which the run resumes."""
        optimizers = [optimizer.state_dict() for optimizer in trainer.optimizers] or self._loaded_optimizers
        saved = {"weights": learner.state_dict(), "updates": learner.updates}
        save_state(self.folder / "resume", self.state, saved, optimizers, self.collect.replay)

    def save_agent(self, name: str, model: WorldModel, info: dict[str, Any]) -> None:
        """Save an agent in `checkpoints/<name>`, with the facts in `info` and the facts of the run."""
        facts = self.facts | info | {"metrics": self.state.evaluations}
        save_checkpoint(self.folder / "checkpoints" / name, model, self.config, facts)

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


class Stop(lightning.Callback):
    """Ends the run at its budget, or when the user interrupts; a second Ctrl-C ends the process at once.

    Args:
        config: Settings of the run, with its budget.
        state: Clocks of the run, and whether the user interrupted it.
    """

    def __init__(self, config: Config, state: RunState) -> None:
        self.run, self.state = config.run, state
        self._previous: dict[int, Any] = {}

    def on_train_start(self, trainer: lightning.Trainer, learner: lightning.LightningModule) -> None:
        """Install the signal handlers."""
        for number in (signal.SIGINT, signal.SIGTERM):
            self._previous[number] = signal.signal(number, self._interrupt)

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: Any) -> None:  # type: ignore[override]
        """Stop between two updates when the minutes are spent or the user interrupted."""
        if self.state.interrupted or self._is_time_spent():
            trainer.should_stop = True

    def on_train_epoch_end(self, trainer: lightning.Trainer, learner: lightning.LightningModule) -> None:
        """Stop after the epoch that learned from the last round."""
        if self.is_spent():
            trainer.should_stop = True

    def on_train_end(self, trainer: lightning.Trainer, learner: lightning.LightningModule) -> None:
        """Restore the previous signal handlers."""
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def is_spent(self) -> bool:
        """Whether the budget of frames or minutes is used up."""
        frames = self.run.frames
        return self._is_time_spent() or (frames is not None and self.state.env_frames >= frames)

    def _is_time_spent(self) -> bool:
        return self.run.minutes is not None and self.state.minutes >= self.run.minutes

    def _interrupt(self, number: int, frame: Any) -> None:
        if self.state.interrupted:
            raise SystemExit(INTERRUPTED)  # Lightning would turn a KeyboardInterrupt into exit code 1
        self.state.interrupted = True
