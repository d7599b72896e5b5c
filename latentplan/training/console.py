"""Progress of a run on the terminal or in a log."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Any

from rich.console import Console

from latentplan.config import RunConfig
from latentplan.config.run_results import Evaluation
from latentplan.reporting.runs import format_evaluation
from latentplan.training.state import RunState

SECONDS_ON_A_TERMINAL = 0.5
SECONDS_IN_A_LOG = 30.0


def own_command(name: str) -> str:
    """How to call a command again: by the script that was called, else by the module, which works in every folder."""
    return f"python {sys.argv[0]}" if Path(sys.argv[0]).name == f"{name}.py" else f"python -m latentplan {name}"


class SteadyConsole(Console):
    """A console that goes silent where nobody reads it any more, as after `train | head`: the run goes on."""

    def on_broken_pipe(self) -> None:
        """Sends what would be printed later to nowhere."""
        self.quiet = True
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


class Progress:
    """Shows one live line on a terminal or one line every 30 seconds in a log, and one line per evaluation.

    Args:
        run: Budget of the run, from which the remaining time is estimated.
        is_quiet: Whether nothing is shown, because another process of the run shows its progress.

    Attributes:
        console: Prints lines that stay.
        episode_return: Mean return of the latest collected episodes, or None.
    """

    def __init__(self, run: RunConfig, is_quiet: bool = False) -> None:
        self.run, self.console = run, SteadyConsole(highlight=False, quiet=is_quiet)
        self.episode_return: float | None = None
        self._evaluation = ""
        self._last_time, self._last_updates = time.monotonic(), 0
        self._rate = 0.0
        self._live = self.console.status("starting") if self.console.is_terminal and not is_quiet else None

    def start(self, updates: int) -> None:
        """Start the display of a run that has made `updates` updates before."""
        self._last_time, self._last_updates = time.monotonic(), updates
        if self._live is not None:
            self._live.start()

    def stop(self) -> None:
        """End the live line."""
        if self._live is not None:
            self._live.stop()

    def update(self, state: RunState, updates: int) -> None:
        """Show clocks and speed, unless the last line was shown less than a pause ago."""
        now = time.monotonic()
        pause = SECONDS_IN_A_LOG if self._live is None else SECONDS_ON_A_TERMINAL
        if now - self._last_time < pause:
            return
        self._rate = (updates - self._last_updates) / (now - self._last_time)
        self._last_time, self._last_updates = now, updates
        line = self._format_line(state, updates)
        if self._live is None:
            self.console.print(line)
        else:
            self._live.update(line)

    def show_evaluation(self, entry: dict[str, Any]) -> None:
        """Print one line for an evaluation, an entry of `RunState.evaluations`."""
        planner, actor = entry["planner"], entry["actor"]
        self._evaluation = f"planner {planner:.0f}, actor {actor:.0f}"
        self.console.print(format_evaluation(Evaluation(*(entry[name] for name in Evaluation._fields))))

    def _format_line(self, state: RunState, updates: int) -> str:
        left = [self.run.minutes - state.minutes] if self.run.minutes else []
        if self.run.frames and state.env_frames:
            left.append(state.minutes * (self.run.frames / state.env_frames - 1.0))
        if self.run.updates and updates:
            left.append(state.minutes * (self.run.updates / updates - 1.0))
        parts = [
            f"{state.env_frames:,} frames" if state.env_frames else f"{updates:,} updates",
            f"{state.minutes:.1f} min",
            f"{self._rate:.1f} updates/s",
            f"episode {self.episode_return:.0f}" if self.episode_return is not None else "",
            self._evaluation,
            f"{max(min(left), 0.0):.0f} min left" if left else "",
        ]
        return " | ".join(part for part in parts if part)


class StatusLine:
    """Shows one live line on a terminal or one line every 30 seconds in a log, between lines that stay."""

    def __init__(self) -> None:
        self.console = SteadyConsole(highlight=False)
        self._last_time = time.monotonic()
        self._live = self.console.status("starting") if self.console.is_terminal else None

    def __enter__(self) -> StatusLine:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()

    def update(self, line: str) -> None:
        """Show a line about the present activity; in a log only if the last line is 30 seconds old."""
        if self._live is not None:
            self._live.update(line)
        elif time.monotonic() - self._last_time >= SECONDS_IN_A_LOG:
            self._last_time = time.monotonic()
            self.console.print(line, soft_wrap=True)

    def print(self, line: str) -> None:
        """Print a line that stays."""
        self.console.print(line, soft_wrap=True)
