"""A training run in a process of its own, which whoever starts many runs can watch and stop."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from latentplan.config.checks import cut

LOG = "train.log"
_TAIL_BYTES = 4096  # of a log, for its last line
_SET_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG of prctl(2)
_LIBRARY = ctypes.CDLL(None) if sys.platform == "linux" else None


class ChildRun:
    """The process of a run on this machine, in a session of its own, which writes into `train.log` of its folder.

    Ctrl-C reaches the parent alone, which decides what becomes of its runs. On Linux, the system sends the run a SIGHUP
    when the thread that started it ends, so that the run saves itself; one that is saving already goes on.

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
                start_new_session=True,
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

    def wait(self, timeout: float | None = None) -> None:
        """Returns when the process has ended, or after a number of seconds."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout)


def last_line(folder: Path) -> str:
    """The last line that the run in a folder has printed, cut to a readable length."""
    log = folder / LOG
    try:
        with log.open("rb") as file:
            file.seek(max(0, log.stat().st_size - _TAIL_BYTES))
            lines = file.read().decode(errors="replace").split("\n")
    except OSError as error:
        return f"{log} cannot be read: {error.strerror}"
    return next((cut(line.strip()) for line in reversed(lines) if line.strip()), f"{log} is empty")


def _end_with_parent() -> None:
    """Makes the system send SIGHUP to this process when the thread that started it ends, however it ends."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # which a parent under `nohup` ignores
    if _LIBRARY is not None:
        _LIBRARY.prctl(_SET_DEATH_SIGNAL, signal.SIGHUP, 0, 0, 0)
