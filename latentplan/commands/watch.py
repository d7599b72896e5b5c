"""`latentplan watch RUN`: show the progress of a training run from another terminal."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from latentplan.config.checks import within
from latentplan.config.parsing import option

if TYPE_CHECKING:
    from latentplan.config.run_results import Evaluation
    from latentplan.reporting.runs import RunSummary

SECONDS_IN_A_LOG = 30.0


@dataclass(frozen=True)
class Request:
    """The command line of watching.

    Attributes:
        folder: Folder of the run.
        every: Seconds between two looks into the folder, in [0.001, 86,400].
    """

    NOTES = "Watching only reads: it never changes or slows the run. Ctrl-C ends the watching and not the run."

    folder: Path = option(metavar="RUN", is_positional=True)
    every: float = 1.0

    def __post_init__(self) -> None:
        within(self, every=(0.001, 86_400))


def run(request: Request) -> int:
    """Print every evaluation of the run, and its clocks in between, until the run ends.

    Returns:
        0; 1 if the run has failed.

    Raises:
        UserError: The folder holds no run, or its files are damaged.
    """
    from latentplan.reporting.runs import format_evaluation, read_run

    shown: set[Evaluation] = set()
    last_line_s = time.monotonic()
    print_heading = True
    while True:
        seen = read_run(request.folder)
        if print_heading:
            print(f"{seen.task}, seed {seen.config.run.seed}, in {seen.folder}", flush=True)
            print_heading = False
        for entry in seen.evaluations:
            if entry not in shown:  # a run that goes on replaces its final evaluation
                _print(format_evaluation(entry))
        shown.update(seen.evaluations)
        if seen.state != "running":
            _print(_describe(seen) + (f": {seen.reason}" if seen.reason else ""))
            return int(seen.state == "failed")
        if sys.stdout.isatty():
            print(f"\r\x1b[K{_describe(seen)}", end="", flush=True)
        elif time.monotonic() - last_line_s >= SECONDS_IN_A_LOG:
            last_line_s = time.monotonic()
            _print(_describe(seen))
        time.sleep(request.every)


def _describe(seen: RunSummary) -> str:
    left = seen.minutes_left
    parts = [seen.state, f"{seen.env_frames:,} frames", f"{seen.minutes:.1f} min"]
    if seen.best is not None:
        parts.append(f"best {seen.best:.1f}")
    if seen.state == "running" and left is not None:
        parts.append(f"about {left:.0f} min left")
    return " | ".join(parts)


def _print(line: str) -> None:
    print(("\r\x1b[K" if sys.stdout.isatty() else "") + line, flush=True)
