"""Rows of results of `benchmark.py suite`: one per evaluation of a run, with the origin of the run, as CSV."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from bench.report import write_csv, write_json
from bench.run_evaluations import read_all_evaluations
from bench.runs import TrainingRun
from latentplan import __version__
from latentplan.config import UserError, make_folder
from latentplan.config.origin import UNKNOWN, describe_commit, describe_hardware
from latentplan.config.reading import LARGEST_DATA, read_text

ORIGIN = "origin.json"
JOINED = " + "  # between two machines or two commits of one run
DIGITS = 2


class Row(NamedTuple):
    """One evaluation.

    Attributes:
        task: The task as domain-task.
        seed: Seed of the run.
        env_frames: Simulator frames, before action repeat.
        minutes: Wall-clock minutes of the run, without the pauses between its processes.
        planner: Mean return of the planner.
        actor: Mean return of the actor.
        updates: Updates of the learner.
        hardware: Machines on which the run was made.
        commit: Commits with which the run was made.
        version: Version of latentplan that began the run.
    """

    task: str
    seed: int
    env_frames: int
    minutes: float
    planner: float
    actor: float
    updates: int
    hardware: str
    commit: str
    version: str


class Origin(NamedTuple):
    """Where a run comes from: its machines, its commits, and the version that began it."""

    hardware: str
    commit: str
    version: str


def present_origin(jobs: int, on_gpu: bool) -> Origin:
    """The origin of a run that begins now.

    Args:
        jobs: Runs side by side.
        on_gpu: Whether the runs learn on a graphics processor.
    """
    hardware = describe_hardware(on_gpu) + (f", {jobs} runs side by side" if jobs > 1 else "")
    return Origin(hardware, describe_commit(), __version__)


def note_origin(folder: Path, origin: Origin) -> None:
    """Adds a machine and a commit to the origin of the run in a folder, before a process of the run starts."""
    before = read_origin(folder)
    if before is not None:
        hardware, commit = (_join(old, new) for old, new in zip(before[:2], origin[:2], strict=True))
        origin = Origin(hardware, commit, before.version)
    make_folder(folder)
    write_json(folder / ORIGIN, origin._asdict())


def read_origin(folder: Path) -> Origin | None:
    """The origin of the run in a folder; None if it was not noted."""
    try:
        values = json.loads((folder / ORIGIN).read_text())
        return Origin(*(str(values[name]) for name in Origin._fields))
    except (OSError, ValueError, TypeError, KeyError):
        return None


def rows_of(run: TrainingRun) -> list[Row]:
    """The rows of a run, in the order of their frames.

    Raises:
        UserError: The files of the run are damaged, or an evaluation is not finite.
    """
    origin = read_origin(run.folder) or Origin(UNKNOWN, UNKNOWN, UNKNOWN)
    evaluations = read_all_evaluations(run.folder)
    for each in evaluations:
        if not all(map(math.isfinite, (each.minutes, each.planner, each.actor))):
            raise UserError(
                f"the evaluation at {each.env_frames:,} frames in {run.folder} is not finite, and no further row "
                "of this run is taken; remove the folder to repeat the run"
            )
    return [
        Row(
            run.task,
            run.seed,
            each.env_frames,
            round(each.minutes, DIGITS),
            round(each.planner, DIGITS),
            round(each.actor, DIGITS),
            each.updates,
            *origin,
        )
        for each in evaluations
    ]


def merge_rows(known: Iterable[Row], new: Iterable[Row]) -> list[Row]:
    """All rows, where new rows of a task, seed and version replace all known rows of the same three.

    Returns:
        The rows in the order of task, seed, version and frames.
    """
    new = list(new)
    replaced = set(map(_key, new))
    rows = [*(row for row in known if _key(row) not in replaced), *new]
    return sorted(rows, key=lambda row: (*_key(row), row.env_frames))


def read_rows(path: Path) -> list[Row]:
    """The rows of a file of results; no rows if there is no such file.

    Raises:
        UserError: The file cannot be read; the message names the line and what it must hold.
    """
    if not path.exists():
        return []
    reader = csv.DictReader(io.StringIO(read_text(path, LARGEST_DATA), newline=""))
    missing = [name for name in Row._fields if name not in (reader.fieldnames or ())]
    if missing:
        raise UserError(f"{path} lacks the column {missing[0]}; it must have: {', '.join(Row._fields)}")
    rows = []
    try:
        for values in reader:
            rows.append(_parse_row(values))
    except (ValueError, TypeError, csv.Error):
        raise UserError(f"{path}, line {reader.line_num}, is no row of results: a number or a cell is wrong") from None
    return rows


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Writes rows as CSV; the file is replaced as a whole, and without rows there is none."""
    if rows:
        write_csv(path, [row._asdict() for row in rows])


def _key(row: Row) -> tuple[str, int, str]:
    return row.task, row.seed, row.version


def _join(old: str, new: str) -> str:
    parts = old.split(JOINED)
    return old if new in parts else JOINED.join([*parts, new])


def _parse_row(values: dict[str, str]) -> Row:
    row = Row(
        values["task"],
        int(values["seed"]),
        int(values["env_frames"]),
        float(values["minutes"]),
        float(values["planner"]),
        float(values["actor"]),
        int(values["updates"]),
        values["hardware"],
        values["commit"],
        values["version"],
    )
    if None in row or "-" not in row.task or not all(map(math.isfinite, (row.minutes, row.planner, row.actor))):
        raise ValueError
    return row
