"""The callbacks of a training run that collect, evaluate and write metrics."""

from __future__ import annotations

import csv
import sys
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lightning
import numpy as np

from latentplan.config import CollectionConfig, Config, EnvironmentFault
from latentplan.config.writing import replaced_whole
from latentplan.models import WorldModel
from latentplan.replay.buffer import Replay
from latentplan.training.collection.collector import Collected
from latentplan.training.collection.crew import WORKER_RESTARTS, Worker
from latentplan.training.collection.episodes import Stopped
from latentplan.training.collection.process import RemoteWorker, WorkerEnded
from latentplan.training.learner.batches import updates_per_epoch
from latentplan.training.ranks import ALONE, Ranks
from latentplan.training.state import RunState

if TYPE_CHECKING:
    from latentplan.training.console import Progress
    from latentplan.training.learner.module import Learner
    from latentplan.training.trackers import Trackers

CLOCKS = ("env_frames", "decisions", "updates", "minutes")
COLUMNS = (*CLOCKS, "episode_return", "planner_return", "actor_return", "planner_minus_actor")  # the losses follow


class Collect(lightning.Callback):
    """Collects one round of experience per epoch, and evaluates the agent when an evaluation is due.

    This callback requests a round from the worker when an epoch starts, and stores the result when the next epoch
    starts. A worker in another process therefore acts while the learner learns, with the averaged weights that the
    learner had when the epoch started. Requests without an answer are part of a save, with the weights they act with: a
    resumed run makes the same requests again, from the same state of the collector. A worker whose process ended is
    replaced in the same way.

    Where several ranks learn together, each collects its share of a round in a worker of its own, and rank 0 evaluates.
    Nobody stores a round or an evaluation before all have it, so that the clocks of all ranks agree. The error of a
    worker that cannot be replaced is raised on all ranks, so that they save together.

    Args:
        config: Settings of the run.
        replay: Stores the collected rows.
        state: Clocks of the run, which this callback advances.
        worker: Collects and evaluates.
        videos: Folder for the films of evaluations.
        requests: Requests of the save from which the run resumes; None in a new run.
        memory: State of the collector in that save; None in a new run.
        ranks: The processes that learn together.

    Attributes:
        requests: Arguments of the round (`collect`) and clocks of the evaluation (`evaluate`) that the worker was asked
            for and has not answered, and the `weights` of both; an entry is None if there is no such request.
        memory: State of the collector after the last round that was stored.
        is_epoch_over: Whether the epoch that ended last was complete.
        evaluated_weights: Weights that the latest evaluation measured.
    """

    def __init__(
        self,
        config: Config,
        replay: Replay,
        state: RunState,
        worker: Worker,
        videos: Path,
        requests: dict[str, Any] | None = None,
        memory: dict[str, Any] | None = None,
        ranks: Ranks = ALONE,
    ) -> None:
        self.config, self.replay, self.state, self.worker, self.videos = config, replay, state, worker, videos
        self.ranks = ranks
        self.requests: dict[str, Any] = requests or {"collect": None, "evaluate": None, "weights": None}
        self.memory = memory
        self.is_epoch_over = False
        self.evaluated_weights: dict[str, np.ndarray] = {}
        self._is_continued = requests is not None
        self._earlier_restarts, self._own_restarts = state.worker_restarts, 0
        self._other_env_restarts, self._others_have_seen_end = 0, False  # of other ranks

    def on_train_epoch_start(self, trainer: lightning.Trainer, learner: Learner) -> None:  # type: ignore[override]
        """Store the results that were requested one epoch ago, and request the next round and evaluation."""
        self.is_epoch_over = False
        try:
            self._start_epoch(learner)
        except Stopped:
            pass
        agree_on_signals(self.state, self.ranks)
        if self.state.interrupted:
            trainer.should_stop = True

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: Any) -> None:  # type: ignore[override]
        """Count the update."""
        self.state.epoch_updates += 1

    def on_train_epoch_end(self, trainer: lightning.Trainer, learner: Learner) -> None:  # type: ignore[override]
        """Make the outstanding behaviour update, before other callbacks read the learner.

        An epoch that a signal cut off stays open, and the resumed run completes it.
        """
        state = self.state
        learner.catch_up()
        is_spent = learner.updates == self.config.run.updates  # the budget may end within an epoch
        is_complete = is_spent or state.epoch_updates >= updates_per_epoch(self.config.collection)
        if state.in_epoch and (is_complete or not state.interrupted):
            state.learned_rounds, state.in_epoch, state.epoch_updates = state.rounds, False, 0
            self.is_epoch_over = True

    @property
    def env_restarts(self) -> int:
        """Environments that were made anew after a fault, over the run until its last round that was stored."""
        return self._other_env_restarts + (0 if self.memory is None else int(self.memory["restarts"]))

    def film_path(self, clocks: Mapping[str, Any]) -> Path:
        """Where the film of the evaluation at these clocks lies, if it was filmed; named by frames, or by updates."""
        frames, updates = clocks["env_frames"], clocks["updates"]
        return self.videos / (f"{frames:09d}.webm" if frames else f"update-{updates:09d}.webm")

    def has_requests(self) -> bool:
        """Whether the worker was asked for something and has not answered."""
        return self.requests["collect"] is not None or self.requests["evaluate"] is not None

    def complete(self) -> None:
        """Wait for all requests, at the end of a run; those of a save are made first.

        Raises:
            Stopped: The run was interrupted; requests without an answer stay.
        """
        self._continue()
        self.store_results()

    def continue_requests(self) -> None:
        """Bring the worker to where it was, and make its requests again."""
        if self.replay.has_recorded_end:
            self.worker.submit("notice_end")
            self.worker.result()
        if self.memory is not None:
            self.worker.submit("restore", self.memory)
            self.worker.result()
        if self.requests["collect"] is not None:
            self._submit_round()
        if self.requests["evaluate"] is not None:
            self._submit_evaluation()

    def store_results(self) -> None:
        """Wait for the requested round and evaluation, and store their results.

        Raises:
            Stopped: The run was interrupted; requests without an answer stay.
            WorkerEnded: The collection process ended too often.
        """
        if self.requests["collect"] is not None:
            fault = self._store_round()
            self.requests["collect"] = None
            if fault is not None:
                raise fault
        if self.requests["evaluate"] is not None:
            returns = self.ranks.lead(self._await_result)
            clocks, self.evaluated_weights = self.requests["evaluate"], self.requests["weights"]
            entry = clocks | {mode: float(np.mean(values)) for mode, values in returns.items()}
            self.state.evaluations.append(entry)
            # Set only now, so that a resumed run repeats an evaluation that was interrupted.
            self.state.next_evaluation = self._evaluation_after(entry)
            self.requests["evaluate"] = None
        self.ranks.together(self._notice_end)

    def _start_epoch(self, learner: Learner) -> None:
        state = self.state
        if self._continue() and state.in_epoch:
            return
        weights = copy_weights(learner.averaged)
        if self.config.collection.enabled:
            self._collect_first(weights)
        if not state.interrupted:
            self.store_results()
        if state.interrupted:
            return
        collect = self._next_round()
        clocks = {"env_frames": state.env_frames, "decisions": state.decisions, "updates": learner.updates}
        is_due = (collect is not None or not self.config.collection.enabled) and self._is_evaluation_due(clocks)
        evaluate = clocks | {"minutes": round(state.minutes, 3)} if is_due else None
        self.requests = {"collect": collect, "evaluate": evaluate, "weights": weights}
        state.in_epoch, state.epoch_updates = True, 0  # from here on, a resumed run makes these requests again
        if collect is not None:
            self._submit_round()
        if evaluate is not None:
            self._submit_evaluation()

    def _collect_first(self, weights: dict[str, np.ndarray]) -> None:
        """Collects the prefill, and the first round after it; a finished run that is extended needs a round too."""
        settings, state = self.config.collection, self.state
        while (missing := min(settings.prefill_decisions - state.decisions, self._decisions_left())) > 0:
            if self.requests["collect"] is None:
                arguments = {"behaviour": "random", "decisions": missing, "counter": state.rounds, "goal": None}
                self.requests |= {"collect": arguments, "weights": None}
                self._submit_round()
            self.store_results()
            if state.interrupted:
                return
        has_new_rows = state.rounds != state.learned_rounds  # false when a finished run is extended
        if self.requests["collect"] is None and not has_new_rows:
            self.requests |= {"collect": self._next_round(), "weights": weights}
            self._submit_round()

    def _is_evaluation_due(self, clocks: Mapping[str, int]) -> bool:
        """Whether an evaluation is due at these clocks."""
        self.state.next_evaluation = min(self.state.next_evaluation, self._evaluation_after(clocks))
        return self._count_frames(clocks) >= self.state.next_evaluation

    def _evaluation_after(self, clocks: Mapping[str, int]) -> int:
        """The frames at which the first evaluation after these clocks is due."""
        every = self.config.evaluation.every_frames
        return (self._count_frames(clocks) // every + 1) * every

    def _count_frames(self, clocks: Mapping[str, int]) -> int:
        """Frames collected so far; without collection those that a run collects in the time of as many updates."""
        collection, repeat = self.config.collection, self.config.env.action_repeat
        if collection.enabled:
            return clocks["env_frames"]
        return int(clocks["updates"] * repeat / collection.updates_per_decision)

    def _await_result(self) -> Any:
        """The next result of the worker; a worker whose process ended is replaced, and repeats its requests."""
        while True:
            try:
                return self.worker.result()
            except WorkerEnded as error:
                self.replace_worker(error)
            except RuntimeError:  # a signal to the whole process group also ends the environments
                if self.state.received:
                    raise Stopped from None
                raise

    def _notice_end(self) -> None:
        """Tell the own worker that an episode of another rank ended in a terminal state."""
        if self._others_have_seen_end and self.memory is not None and not self.memory["has_seen_end"]:
            self.memory["has_seen_end"] = True
            try:
                self.worker.submit("notice_end")
                self.worker.result()
            except WorkerEnded as error:
                self.replace_worker(error)

    def replace_worker(self, error: WorkerEnded) -> None:
        """Start a new collection process in place of one that ended, and repeat the requests.

        Raises:
            WorkerEnded: Too many processes have ended since the run was started or resumed.
        """
        state = self.state
        while isinstance(self.worker, RemoteWorker) and self._own_restarts < WORKER_RESTARTS:
            state.worker_restarts += 1
            self._own_restarts += 1
            warnings.warn(
                f"{error}: it is started again ({self._own_restarts} of {WORKER_RESTARTS} times), and repeats its "
                "round",
                RuntimeWarning,
                stacklevel=2,
            )
            self.worker.restart()
            try:
                return self.continue_requests()
            except WorkerEnded as again:  # the new process ended while it was being prepared
                error = again
        raise error

    def _continue(self) -> bool:
        """Make the requests of the save, if that was not done yet; returns whether it was done now."""
        if not self._is_continued:
            return False
        self._is_continued = False
        self.ranks.together(self._restore_worker)
        return True

    def _restore_worker(self) -> None:
        try:
            self.continue_requests()
        except WorkerEnded as error:
            self.replace_worker(error)

    def _next_round(self) -> dict[str, Any] | None:
        """Arguments of the next round; None if the budget has no frames left, or the run collects nothing."""
        settings, state = self.config.collection, self.state
        decisions = min(settings.round_decisions, self._decisions_left())
        if decisions <= 0 or not settings.enabled:
            return None
        behaviour, goal = choose_behaviour(settings, state.rounds, state.env_frames)
        return {"behaviour": behaviour, "decisions": decisions, "counter": state.rounds, "goal": goal}

    def _decisions_left(self) -> int:
        frames = self.config.run.frames
        if frames is None:
            return sys.maxsize
        return -(-(frames - self.state.env_frames) // self.config.env.action_repeat)

    def _submit_round(self) -> None:
        arguments = self.requests["collect"]
        share = -(-arguments["decisions"] // self.ranks.size)
        self.worker.submit("collect", self.requests["weights"], *(arguments | {"decisions": share}).values())

    def _submit_evaluation(self) -> None:
        if not self.ranks.is_first:
            return
        settings = self.config.evaluation
        film = self.film_path(self.requests["evaluate"]) if settings.video else None
        self.worker.submit("evaluate", settings.episodes, film, self.requests["weights"])

    def _store_round(self) -> EnvironmentFault | None:
        """Stores a round once all ranks have it, and returns the fault that ended it early on one of them."""
        own: list[Collected] = []

        def take() -> tuple[Collected, int]:
            own.append(self._await_result())
            facts = {name: (own[0].memory or {}).get(name, 0) for name in ("restarts", "has_seen_end")}
            return replace(own[0], rows=[], memory=facts), self._own_restarts + self.worker.replaced

        rounds, restarts = zip(*self.ranks.together(take), strict=True)
        for lane, rows in enumerate(own[0].rows):
            self.replay.add(lane, rows)
        state, self.memory = self.state, own[0].memory
        state.env_frames += sum(part.env_frames for part in rounds)
        state.decisions += sum(part.decisions for part in rounds)
        state.rounds += 1
        state.worker_restarts = self._earlier_restarts + sum(restarts)
        others = [part.memory for rank, part in enumerate(rounds) if rank != self.ranks.rank]
        self._other_env_restarts = sum(memory["restarts"] for memory in others)
        self._others_have_seen_end = any(memory["has_seen_end"] for memory in others)
        for part in rounds:
            state.episode_returns.extend(part.episode_returns)
        return next((part.fault for part in rounds if part.fault is not None), None)


def agree_on_signals(state: RunState, ranks: Ranks) -> None:
    """Stops the run on all ranks if one of them has received a signal; every rank must call this at the same time."""
    if ranks.size > 1:
        state.interrupted = ranks.largest(state.received)


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
        with replaced_whole(self.path) as part, part.open("w", newline="") as file:
            writer = csv.DictWriter(file, columns)
            writer.writeheader()
            writer.writerows(rows)


class Record(lightning.Callback):
    """Writes metrics.csv and the trackers once per epoch, and moves the progress display.

    Every entry of `Learner.metrics` becomes a column and a scalar of the same name in each tracker.

    Args:
        path: Path of metrics.csv.
        state: Clocks and evaluations of the run.
        collect: Says whether an epoch was complete.
        progress: Display of the run.
        trackers: The trackers of the run.
    """

    def __init__(self, path: Path, state: RunState, collect: Collect, progress: Progress, trackers: Trackers) -> None:
        self.trackers = trackers
        self.file, self.state, self.collect, self.progress = MetricsFile(path, COLUMNS), state, collect, progress
        self._num_written_evaluations = len(state.evaluations)

    def on_train_epoch_start(self, trainer: lightning.Trainer, learner: Learner) -> None:  # type: ignore[override]
        """Append the row of an evaluation that has just finished."""
        self.write_evaluations()

    def on_train_batch_end(self, trainer: lightning.Trainer, learner: Learner, *_: Any) -> None:  # type: ignore[override]
        """Update the progress display."""
        self.progress.update(self.state, learner.updates)

    def on_train_epoch_end(self, trainer: lightning.Trainer, learner: Learner) -> None:  # type: ignore[override]
        """Append one row for the epoch, unless a signal cut it off."""
        if not self.collect.is_epoch_over:
            return
        state = self.state
        clocks = {"env_frames": state.env_frames, "decisions": state.decisions, "updates": learner.updates}
        row: dict[str, float] = clocks | {"minutes": round(state.minutes, 3)}
        if state.episode_returns:
            row["episode_return"] = float(np.mean(state.episode_returns))
            self.progress.episode_return = row["episode_return"]
            state.episode_returns.clear()
        for name in sorted(learner.metrics, key=lambda name: name.endswith("_grad_norm")):  # losses, then the norms
            row[name] = float(learner.metrics[name])
        if skipped := sum(int(half.total) for half in learner.skips):
            row["skipped_steps"] = skipped
        if state.worker_restarts:
            row["worker_restarts"] = state.worker_restarts
        if self.collect.env_restarts:
            row["env_restarts"] = self.collect.env_restarts
        self._append(row)

    def write_evaluations(self) -> None:
        """Append one row per new evaluation, with the clocks of the weights that were evaluated."""
        for entry in self.state.evaluations[self._num_written_evaluations :]:
            returns = {"planner_return": entry["planner"], "actor_return": entry["actor"]}
            difference = {"planner_minus_actor": entry["planner"] - entry["actor"]}
            self._append({name: entry[name] for name in CLOCKS} | returns | difference)
            self.trackers.log_film(self.collect.film_path(entry), step=entry["env_frames"] or entry["updates"])
            self.progress.show_evaluation(entry)
        self._num_written_evaluations = len(self.state.evaluations)

    def _append(self, row: dict[str, float]) -> None:
        self.trackers.log(row, step=int(row["env_frames"] or row["updates"]))
        self.file.append(row)
