"""A queue of training runs, some of them side by side, that survives any interruption.

Every run is a `ChildRun`, on this machine or on one of a Ray cluster. The first SIGINT, SIGTERM or SIGHUP lets each run
save itself; where the queue itself is killed, the system tells the runs.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from bench.runs import TrainingRun
from bench.suite_progress import Board
from latentplan.config import UserError
from latentplan.config.run_results import is_locked
from latentplan.training.child_run import ChildRun, last_line
from latentplan.training.signals import Signals

if TYPE_CHECKING:
    from bench.suite_ray import RayProcess

STOPPED = (-signal.SIGTERM, 128 + signal.SIGTERM)  # exit codes of a run that was asked to end; the first while it loads
POLL_S = 1.0


class Queue:
    """Training runs in the order in which they start.

    Args:
        runs: The runs; those that are finished are not started.
        jobs: Largest number of runs side by side.
        board: Is told about every change, and once per second which runs are active.
        start: Starts the process of a run; None starts it on this machine.
    """

    def __init__(
        self,
        runs: Sequence[TrainingRun],
        jobs: int,
        board: Board,
        start: Callable[[TrainingRun], RayProcess] | None = None,
    ) -> None:
        self.start: Callable[[TrainingRun], ChildRun | RayProcess] = start or _start_here
        self.waiting = [run for run in runs if not run.is_finished()]
        self.jobs, self.board = jobs, board
        self.active: dict[TrainingRun, ChildRun | RayProcess] = {}
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
                        self.board.stop(list(self.active))
                        self._stop()
                    self.board.look(list(self.active))
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
                    self.board.wait(run)
                continue
            self.waiting.remove(run)
            try:
                self.board.begin(run)
                self.active[run] = self.start(run)
            except (UserError, OSError) as error:  # such as a folder in which nothing can be written
                self.board.fail(run, str(error))

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
                self.board.finish(run)
            elif self._is_stopping and code in STOPPED:
                self.board.pause(run)
            else:
                self.board.fail(run, _describe_end(code, run.folder))


def _start_here(run: TrainingRun) -> ChildRun:
    return ChildRun(run.folder, run.command())


def _describe_end(code: int, folder: Path) -> str:
    end = f"exit code {code}" if code >= 0 else f"{signal.Signals(-code).name}"
    return f"{end}: {last_line(folder)}"
