"""A queue of training runs, some of them side by side, that survives any interruption.

Every run is a `train.py` process in a session of its own, on this machine or on one of a Ray cluster, which writes into
`train.log` in the folder of the run. The first SIGINT, SIGTERM or SIGHUP lets each run save itself; where the queue
itself is killed, the system tells the runs.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from bench.runs import TrainingRun
from latentplan.config import UserError
from latentplan.config.checks import cut
from latentplan.config.run_results import is_locked
from latentplan.training.signals import Signals

LOG = "train.log"
STOPPED = (-signal.SIGTERM, 128 + signal.SIGTERM)  # exit codes of a run that was asked to end; the first while it loads
POLL_S = 1.0
_TAIL_BYTES = 4096  # of a log, for its last line
_SET_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG of prctl(2)


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
    """The process of a run; see `LocalProcess`."""

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
        self.start = start or (lambda run: LocalProcess(run.folder, run.command()))
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
            self.observer.begin(run)
            try:
                self.active[run] = self.start(run)
            except UserError as error:
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
                self.observer.fail(run, _describe_end(code, run.folder / LOG))


class LocalProcess:
    """The process of a run on this machine.

    Args:
        folder: Folder of the run, which exists.
        command: The command line.
    """

    def __init__(self, folder: Path, command: Sequence[str]) -> None:
        with (folder / LOG).open("ab") as log:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C reaches the queue alone, which tells each run once
                preexec_fn=_end_with_parent,
            )

    def poll(self) -> int | None:
        """The exit code; None while the process runs. Of a process that has ended, ends what it has left behind."""
        code = self._process.poll()
        if code is not None:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, signal.SIGKILL)
        return code

    def stop(self) -> None:
        """Asks the process to save the run and to end."""
        self._process.send_signal(signal.SIGTERM)

    def wait(self) -> None:
        """Returns when the process has ended."""
        self._process.wait()


_LIBRARY = ctypes.CDLL(None) if sys.platform == "linux" else None


def _end_with_parent() -> None:
    """Makes the system send SIGTERM to this process when its parent ends, however it ends."""
    if _LIBRARY is not None:
        _LIBRARY.prctl(_SET_DEATH_SIGNAL, signal.SIGTERM, 0, 0, 0)


def _describe_end(code: int, log: Path) -> str:
    end = f"exit code {code}" if code >= 0 else f"{signal.Signals(-code).name}"
    return f"{end}: {_last_line(log)}"


def _last_line(log: Path) -> str:
    try:
        with log.open("rb") as file:
            file.seek(max(0, log.stat().st_size - _TAIL_BYTES))
            lines = file.read().decode(errors="replace").split("\n")
    except OSError as error:
        return f"{log} cannot be read: {error.strerror}"
    return next((cut(line.strip()) for line in reversed(lines) if line.strip()), f"{log} is empty")
