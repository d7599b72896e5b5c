"""Training runs as people list, watch and compare them."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from latentplan.config import Config, UserError
from latentplan.config.run_folder import RUN_FILE, SAVES_FOLDER
from latentplan.config.run_results import (
    STATUS_FILE,
    Evaluation,
    StateName,
    find_state,
    read_evaluations,
    read_progress,
    read_settings,
)

DEEPEST = 2  # levels of folders below the one that is listed; a sweep keeps its runs in a folder of its own
COLUMNS = ("run", "task", "seed", "frames", "minutes", "best", "last", "state")


@dataclass(frozen=True)
class RunSummary:
    """A training run, as its folder describes it.

    Attributes:
        folder: Folder of the run.
        config: Settings.
        env_frames: Frames of the latest row of metrics or of the latest evaluation.
        minutes: Wall-clock minutes at these frames.
        evaluations: Evaluations in the order of their frames.
        state: Whether the run is running, finished, stopped or failed.
        reason: Why the run has failed; None where it has not.
    """

    folder: Path
    config: Config
    env_frames: int
    minutes: float
    evaluations: Sequence[Evaluation]
    state: StateName
    reason: str | None

    @property
    def task(self) -> str:
        """The task as domain-task."""
        env = self.config.env
        return env.domain if env.task is None else f"{env.domain}-{env.task}"

    @property
    def best(self) -> float | None:
        """Highest mean return of the planner in an evaluation; None before the first."""
        return max((each.planner for each in self.evaluations), default=None)

    @property
    def last(self) -> float | None:
        """Mean return of the planner in the latest evaluation; None before the first."""
        return self.evaluations[-1].planner if self.evaluations else None

    @property
    def minutes_left(self) -> float | None:
        """Minutes until the budget is spent, at the speed so far; None where they cannot be estimated."""
        run, left = self.config.run, []
        if run.minutes:
            left.append(run.minutes - self.minutes)
        if run.frames and self.env_frames:
            left.append(self.minutes * (run.frames / self.env_frames - 1.0))
        if run.updates and self.evaluations and self.evaluations[-1].updates:
            last = self.evaluations[-1]
            left.append(last.minutes * run.updates / last.updates - self.minutes)
        return max(0.0, min(left)) if left else None


def read_run(folder: Path) -> RunSummary:
    """The run in a folder.

    Raises:
        UserError: The folder holds no run, or its files are damaged.
    """
    config, evaluations = read_settings(folder), read_evaluations(folder)
    progress = read_progress(folder)
    frames, minutes = progress["env_frames"], progress["minutes"]
    if evaluations and evaluations[-1].env_frames >= frames:
        frames, minutes = evaluations[-1].env_frames, max(minutes, evaluations[-1].minutes)
    return RunSummary(folder, config, int(frames), minutes, evaluations, *find_state(folder))


def find_runs(folder: Path) -> tuple[list[RunSummary], list[str]]:
    """The runs in a folder and in the folders below it, and one line for each folder that is no run.

    Raises:
        UserError: There is no such folder, or it cannot be read.
    """
    if not folder.is_dir():
        raise UserError(f"there is no folder {folder}: give the folder that holds runs")
    if not os.access(folder, os.R_OK | os.X_OK):
        raise UserError(f"the folder {folder} may not be read: give one that this user may read")
    runs, problems = [], []
    for path, problem in _walk(folder, DEEPEST):
        try:
            if problem is not None:
                raise UserError(problem)
            runs.append(read_run(path))
        except UserError as error:
            problems.append(str(error))
        except OSError as error:
            problems.append(_describe_unreadable(path, error))
    return runs, problems


def format_table(rows: Sequence[Sequence[str]], right: Sequence[int]) -> str:
    """Rows as lines of aligned columns, the first row as the header.

    Args:
        rows: Cells; every row has the same number.
        right: Columns that are aligned to the right.
    """
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = [
            cell.rjust(width) if column in right else cell.ljust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


def format_runs(runs: Sequence[RunSummary], folder: Path) -> str:
    """The runs as a table; names are relative to the folder that is listed."""
    rows: list[Sequence[str]] = [COLUMNS]
    for run in runs:
        name = str(run.folder.relative_to(folder)) if run.folder.is_relative_to(folder) else str(run.folder)
        clocks = f"{run.env_frames:,}", f"{run.minutes:.1f}"
        state = run.state if run.reason is None else f"{run.state}: {run.reason}"
        returns = format_return(run.best), format_return(run.last)
        rows.append(
            (run.folder.name if name == "." else name, run.task, str(run.config.run.seed), *clocks, *returns, state)
        )
    return format_table(rows, right=range(2, 7))


def format_return(value: float | None) -> str:
    """A return with one digit after the point; a dash without one."""
    return "-" if value is None else f"{value:.1f}"


def format_evaluation(entry: Evaluation) -> str:
    """An evaluation as one line, with the updates of a run that has collected no frames."""
    clock = f"{entry.env_frames:>9,} frames" if entry.env_frames else f"{entry.updates:>9,} updates"
    return (
        f"{clock}  {entry.minutes:6.1f} min  planner {entry.planner:6.1f}  "
        f"actor {entry.actor:6.1f}  difference {entry.planner - entry.actor:+6.1f}"
    )


def _walk(folder: Path, depth: int) -> Iterator[tuple[Path, str | None]]:
    """Every folder that may be a run, in order of names, and why it is none; None where it looks like a run."""
    try:
        is_run = any((folder / name).exists() for name in (RUN_FILE, STATUS_FILE, SAVES_FOLDER))
        below = sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))
    except OSError as error:
        yield folder, _describe_unreadable(folder, error)
        return
    if is_run:
        yield folder, None
        return
    foreign = folder, f"{folder} holds no training run"
    if depth == 0 or not below:
        yield foreign
        return
    found = [entry for path in below for entry in _walk(path, depth - 1)]
    if depth == DEEPEST or any(problem is None for _, problem in found):
        yield from found
    else:
        yield foreign  # the folders of something else are not listed one by one


def _describe_unreadable(folder: Path, error: OSError) -> str:
    return f"{folder} cannot be read: {error.strerror or error}"
