"""A queue of training runs, some of them side by side, that survives any interruption.

Every run is a `ChildRun`, on this machine or on one of a Ray cluster. The first SIGINT, SIGTERM or SIGHUP lets each run
save itself; where the queue itself is killed, the system tells the runs.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from bench.runs import TrainingRun
from latentplan.config import UserError
from latentplan.config.run_results import is_locked
from latentplan.training.child_run import ChildRun, last_line
from latentplan.training.signals import Signals

STOPPED = (-signal.SIGTERM, 128 + signal.SIGTERM)  # exit codes of a run that was asked to end; the first while it loads
POLL_S = 1.0


class Observer(Protocol):
    """What is told about the runs of a queue."""

    def begin(self, run: TrainingRun) -> None:
        """A process of the run is about to start; its folder is made here."""

    def look(self, active: Sequence[TrainingRun]) -> None:
        """These runs are active; called once per second."""

    def wait(self, run: TrainingRun) -> None:
        """Another process has the folder of the run, which starts when the folder is free."""

    def finish(self, run: TrainingRun) -> None:
        """The run has ended with its budget."""

    def fail(self, run: TrainingRun, reason: str) -> None:
        """The run has ended in another way."""

    def stop(self, active: Sequence[TrainingRun]) -> None:
        """A signal ends the queue, and these runs save themselves."""

    def pause(self, run: TrainingRun) -> None:
        """The run has ended after the signal, and goes on at the next start."""


class Process(Protocol):
    """The process of a run; see `ChildRun`."""

    def poll(self) -> int | None:
        """The exit code; None while the process runs."""

    def stop(self) -> None:
        """Asks the process to save the run and to end."""

    def wait(self) -> None:
        """Returns when the process has ended."""


class Queue:
    """Training runs in the order in which they start.

    Args:
        runs: The runs; those that are finished are not started.
        jobs: Largest number of runs side by side.
        observer: Is told about every change.
        start: Starts the process of a run; None starts it on this machine.
    """

    def __init__(
        self,
        runs: Sequence[TrainingRun],
        jobs: int,
        observer: Observer,
        start: Callable[[TrainingRun], Process] | None = None,
    ) -> None:
        self.start = start or (lambda run: ChildRun(run.folder, run.command()))
        self.waiting = [run for run in runs if not run.is_finished()]
        self.jobs, self.observer = jobs, observer
        self.active: dict[TrainingRun, Process] = {}
        self._busy: set[TrainingRun] = set()
        self._is_stopping = False

    def work_off(self) -> int:
        """Runs all runs to their ends, or until a signal.

        Returns:
            Number of the signal that ended the queue; 0 without one.
        """
        with Signals() as signals:
            try:
                while self.active or (self.waiting and not signals.received):
                    if not signals.received:
                        self._fill()
                    elif not self._is_stopping:
                        self.observer.stop(list(self.active))
                        self._stop()
                    self.observer.look(list(self.active))
                    self._collect()
                    time.sleep(POLL_S)
            finally:  # also after an error here, such as a full disk: runs that are not waited for get a second signal
                self._stop()
                for process in self.active.values():
                    process.wait()
        return signals.received

    def _fill(self) -> None:
        """Starts waiting runs until enough are active."""
        for run in list(self.waiting):
            if len(self.active) >= self.jobs:
                return
            if is_locked(run.folder):  # such as a run of a sweep that was killed and that still saves itself
                if run not in self._busy:
                    self._busy.add(run)
                    self.observer.wait(run)
                continue
            self.waiting.remove(run)
            try:
                self.observer.begin(run)
                self.active[run] = self.start(run)
            except (UserError, OSError) as error:  # such as a folder in which nothing can be written
                self.observer.fail(run, str(error))

    def _stop(self) -> None:
        """Asks every active run once to save itself and to end; a second signal would end it without a save."""
        if not self._is_stopping:
            self._is_stopping = True
            for process in self.active.values():
                process.stop()

    def _collect(self) -> None:
        """Takes the runs that have ended from the active ones."""
        for run, process in list(self.active.items()):
            code = process.poll()
            if code is None:
                continue
            del self.active[run]
            if code == 0:
                run.mark_finished()
                self.observer.finish(run)
            elif self._is_stopping and code in STOPPED:
                self.observer.pause(run)
            else:
                self.observer.fail(run, _describe_end(code, run.folder))


def _describe_end(code: int, folder: Path) -> str:
    end = f"exit code {code}" if code >= 0 else f"{signal.Signals(-code).name}"
    return f"{end}: {last_line(folder)}"
