"""Progress of `benchmark.py suite`: rows of results as they come, lines on the terminal, and the time that is left."""

from __future__ import annotations

import heapq
import statistics
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from bench.run_evaluations import keep_final
from bench.runs import TrainingRun
from bench.suite_rows import Origin, Row, merge_rows, note_origin, read_origin, read_rows, rows_of, write_rows
from latentplan.config import UserError, make_folder
from latentplan.config.run_results import FINAL_FILE, METRICS_FILE, read_progress
from latentplan.training.child_run import LOG

LOOK_S = 5.0
STATUS_S = 300.0  # between two lines about the whole sweep where there is no terminal
LEAST_SHARE = 0.05  # of a run, from which its speed is known; collection before the first update is faster
CLOCK_OF_LIMIT = {"--frames": "env_frames", "--minutes": "minutes", "--updates": "updates"}  # columns of metrics


class Progress(NamedTuple):
    """How far a run is: the share of its budget that is spent, and the minutes that this took."""

    share: float
    minutes: float


class Board:
    """Keeps the rows of all runs in a file, and prints what happens to the runs.

    Args:
        runs: All runs of the sweep, in their order.
        jobs: Runs side by side.
        results: File of results; rows of other runs in it stay.
        origin: Origin of a run that begins now; None where the machine of the run notes it.

    Attributes:
        rows: The rows in the file.
        failures: The reason of each run that failed, by run.

    Raises:
        UserError: The file of results cannot be read.
    """

    def __init__(self, runs: Sequence[TrainingRun], jobs: int, results: Path, origin: Origin | None) -> None:
        self.runs, self.jobs, self.results, self.origin = runs, jobs, results, origin
        self.failures: dict[TrainingRun, str] = {}
        self.rows = read_rows(results)
        self._changes: dict[TrainingRun, tuple[tuple[int, int], ...]] = {}
        self._seen: dict[TrainingRun, list[Row]] = {}
        self._progress = {run: measure_progress(run) for run in runs}
        self._looked, self._stated = 0.0, time.monotonic()
        for run in runs:
            self._read(run)
        write_rows(results, self.rows)

    def begin(self, run: TrainingRun) -> None:
        """Note the origin and the final evaluation of a run, whose process is about to start."""
        is_begun = read_origin(run.folder) is not None
        make_folder(run.folder)
        keep_final(run.folder)
        if self.origin is not None:
            note_origin(run.folder, self.origin)
        self._print(f"{run.name}: {'goes on' if is_begun else 'begins'}; its log is {run.folder / LOG}")

    def look(self, active: Sequence[TrainingRun]) -> None:
        """Take new evaluations of active runs into the file of results; at most once in five seconds.

        Without a terminal the state of the sweep is printed at least every five minutes.
        """
        if time.monotonic() - self._looked < LOOK_S:
            return
        self._looked = time.monotonic()
        is_quiet = not sys.stdout.isatty() and self._looked - self._stated >= STATUS_S
        if any([self._update(run) for run in active]) or is_quiet:
            self._print_status()
        if sys.stdout.isatty():
            print(f"\r\x1b[K{self.status()}", end="", flush=True)

    def wait(self, run: TrainingRun) -> None:
        """Say that a run has to wait."""
        self._print(f"{run.name}: waits, because another process learns in {run.folder}")

    def finish(self, run: TrainingRun) -> None:
        """Take the last rows of a run."""
        self._update(run)
        self._print(f"{run.name}: finished")
        self._print_status()

    def fail(self, run: TrainingRun, reason: str) -> None:
        """Remember why a run failed; the next start of the sweep tries the run again."""
        self._update(run)
        self.failures[run] = reason
        self._print(f"{run.name}: failed, {reason}")
        self._print_status()

    def stop(self, active: Sequence[TrainingRun]) -> None:
        """Say that runs save themselves."""
        names = "; ".join(run.name for run in active)
        self._print(f"stopping, after a save of {names}" if names else "stopping")

    def pause(self, run: TrainingRun) -> None:
        """Take the last rows of a run that has saved itself."""
        self._update(run)
        self._print(f"{run.name}: saved")

    def status(self) -> str:
        """One line about the whole sweep."""
        finished = sum(run.is_finished() for run in self.runs)
        share = statistics.fmean(progress.share for progress in self._progress.values())
        failed = f", {len(self.failures)} failed" if self.failures else ""
        going = {run: progress for run, progress in self._progress.items() if run not in self.failures}
        left = estimate_minutes_left(going, self.jobs)
        rest = f"; {format_left(left)}" if finished < len(self.runs) else ""
        return f"{finished} of {len(self.runs)} runs finished{failed}, {share:.1%} of the work{rest}"

    def _read(self, run: TrainingRun) -> bool:
        """Read the rows of a run if its files have changed; returns whether its rows have changed."""
        files = (run.folder / METRICS_FILE, run.folder / FINAL_FILE)
        # Two writes may fall into one tick of the clock of a file system, so a time alone does not show every change.
        changes = tuple((path.stat().st_mtime_ns, path.stat().st_size) for path in files if path.exists())
        if changes == self._changes.get(run, ()):
            return False
        try:
            rows = rows_of(run)
        except UserError as error:
            if run.is_finished():  # else a file may just be written
                self._print(f"{run.name}: {error}")
            return False
        self._changes[run] = changes
        if rows == self._seen.get(run, []):
            return False
        self._seen[run] = rows
        self.rows = merge_rows(self.rows, rows)
        return True

    def _update(self, run: TrainingRun) -> bool:
        """Measure how far a run is, and take its rows; writes all rows if those of the run have changed.

        Returns:
            Whether the rows have changed; the last row of the run is printed then.
        """
        self._progress[run] = measure_progress(run)
        if not self._read(run) or not self._seen[run]:
            return False
        write_rows(self.results, self.rows)
        last = self._seen[run][-1]
        clocks = f"{last.env_frames:,} frames in {last.minutes:,.1f} min"
        self._print(f"{run.name}: {clocks}, planner {last.planner:.1f}, actor {last.actor:.1f}")
        return True

    def _print_status(self) -> None:
        self._stated = time.monotonic()
        self._print(self.status())

    def _print(self, line: str) -> None:
        print(("\r\x1b[K" if sys.stdout.isatty() else "") + line, flush=True)


def measure_progress(run: TrainingRun) -> Progress:
    """How far a run is, from the largest clocks in its metrics."""
    spent = read_progress(run.folder)
    share = max(spent[CLOCK_OF_LIMIT[name]] / limit for name, limit in run.limits.items())
    return Progress(1.0 if run.is_finished() else min(1.0, share), spent["minutes"])


def estimate_minutes_left(progress: Mapping[TrainingRun, Progress], jobs: int) -> float | None:
    """Minutes until all runs are finished; None before the speed of any run is known.

    A run goes on as fast as it was, and a run that has not begun is as fast as others of its domain, or as all others.

    Args:
        progress: How far each run is, in the order of their starts.
        jobs: Runs side by side.
    """
    whole = {run: minutes / share for run, (share, minutes) in progress.items() if share >= LEAST_SHARE}
    if not whole:
        return None
    by_domain: dict[str, list[float]] = {}
    for run, minutes in whole.items():
        by_domain.setdefault(_domain(run), []).append(minutes)
    mean = statistics.fmean(whole.values())
    ends = [0.0] * jobs  # when each place in the queue becomes free
    for run, (share, _) in progress.items():
        expected = whole.get(run) or statistics.fmean(by_domain.get(_domain(run), [mean]))
        heapq.heapreplace(ends, ends[0] + (1.0 - share) * expected)
    return max(ends)


def format_left(minutes: float | None) -> str:
    """The time that is left, in words."""
    if minutes is None:
        return "the time left is not known yet"
    hours, rest = divmod(round(minutes), 60)
    days, hours = divmod(hours, 24)
    parts = [f"{days} d"] * bool(days) + [f"{hours} h"] * bool(days or hours) + [f"{rest} min"] * (not days)
    return f"about {' '.join(parts)} left"


def _domain(run: TrainingRun) -> str:
    return run.task.partition("-")[0]
