"""What the folder of a run tells about the run: its evaluations, its clocks, its settings and its state."""

from __future__ import annotations

import csv
import fcntl
import io
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

from latentplan.config.checks import UserError, cut
from latentplan.config.files import read_config
from latentplan.config.reading import LARGEST_DATA, read_text
from latentplan.config.run_folder import LOCK_FILE, RUN_FILE, run_saves
from latentplan.config.settings import Config, RunConfig, by_key, to_dict
from latentplan.config.suites import check_task
from latentplan.config.writing import write_whole

METRICS_FILE, FINAL_FILE, STATUS_FILE = "metrics.csv", "final.json", "status.json"
CLOCKS = ("env_frames", "minutes", "updates")  # columns of metrics
StateName = Literal["running", "finished", "stopped", "failed"]
_DAMAGES = (OSError, ValueError, TypeError, KeyError, OverflowError, RecursionError, csv.Error)  # of files of results


class Evaluation(NamedTuple):
    """One evaluation of a run: its clocks, and the mean returns of planner and actor."""

    env_frames: int
    minutes: float
    planner: float
    actor: float
    updates: int


def read_evaluations(folder: Path) -> list[Evaluation]:
    """The evaluations of a run, in the order of their frames; empty before the first.

    The final evaluation takes the place of an earlier one at the same frames.

    Raises:
        UserError: The files of the run are damaged.
    """
    try:
        found = {moment_of(each): each for each in _read_metrics(folder / METRICS_FILE)}
        if (folder / FINAL_FILE).exists():
            final = json.loads(read_text(folder / FINAL_FILE, LARGEST_DATA))
            last = _to_evaluation(*(final[name] for name in Evaluation._fields))
            found[moment_of(last)] = last
    except KeyError as error:
        raise UserError(f"the results in {folder} cannot be read: they lack {error}") from None
    except _DAMAGES as error:
        raise UserError(f"the results in {folder} cannot be read: {error}") from None
    return [found[moment] for moment in sorted(found)]


def read_log(info: Mapping[str, Any]) -> list[Evaluation]:
    """The evaluations in the `info.json` of an agent, without entries that are not whole."""
    log = info.get("metrics")
    entries = [entry for entry in log if isinstance(entry, dict)] if isinstance(log, list) else []
    return [Evaluation(*(entry[name] for name in Evaluation._fields)) for entry in entries if _is_whole(entry)]


def read_progress(folder: Path) -> dict[str, float]:
    """How far a run is: its largest `env_frames`, `minutes` and `updates`; zeros before the first row of metrics.

    The row of an evaluation has the clocks of its beginning, and may come after a later row of learning.
    """
    try:
        rows = list(read_rows(folder / METRICS_FILE))
        return {clock: max((float(row[clock]) for row in rows), default=0.0) for clock in CLOCKS}
    except _DAMAGES:  # a damaged file, which the run itself reports
        return dict.fromkeys(CLOCKS, 0.0)


def read_rows(path: Path) -> Iterator[dict[str, str]]:
    """The rows of a file of metrics, without a last line that is still being written."""
    if path.exists():
        text = read_text(path, LARGEST_DATA)
        yield from csv.DictReader(io.StringIO(text[: text.rfind("\n") + 1], newline=""))


def read_settings(folder: Path) -> Config:
    """The settings of a run; those of its last save where `config.yaml` cannot be read.

    Raises:
        UserError: The folder holds no run, or its settings cannot be read.
    """
    path = folder / RUN_FILE
    if not folder.is_dir():
        raise UserError(f"there is no folder {folder}")
    if not path.exists() and (folder / STATUS_FILE).exists():
        raise UserError(f"{folder} has no settings yet: its run is being set up, or could not begin")
    if not path.exists() and not run_saves(folder).exist():
        raise UserError(f"{folder} holds no training run: it has no {RUN_FILE}")
    try:
        return read_config(path)
    except UserError:
        copy = run_saves(folder).find(RUN_FILE)
        if copy is None:
            raise
        return read_config(copy)


def comparable_settings(config: Config) -> dict[str, Any]:
    """The settings by name, with the default task filled in and without the budget and folder of the run."""
    task = config.env.task or check_task(config.env.suite, config.env.domain)[0]
    settings = replace(config, env=replace(config.env, task=task), run=RunConfig(seed=config.run.seed))
    return by_key(to_dict(settings))


def note_state(folder: Path, state: StateName, **facts: Any) -> None:
    """Writes the state of a run, and adds facts to those that were written before."""
    path = folder / STATUS_FILE
    write_whole(path, json.dumps(read_facts(folder) | {"state": state, "reason": None} | facts, indent=1) + "\n")


def read_facts(folder: Path, name: str = STATUS_FILE) -> dict[str, Any]:
    """What a run has noted in a file of JSON; empty without the file, or where it is damaged.

    Args:
        folder: Folder of the run.
        name: The file; `status.json` has `state`, `reason`, `command`, `commit` and others.
    """
    try:
        facts = json.loads(read_text(folder / name, LARGEST_DATA))
    except _DAMAGES:
        return {}
    return facts if isinstance(facts, dict) else {}


def find_state(folder: Path) -> tuple[StateName, str | None]:
    """The state of a run, and the reason if it has failed.

    A run is running while a process holds its lock. A run that notes that it is running while no process holds its
    lock was killed, and has failed. Runs of versions that note no state are finished after their final evaluation.
    """
    if is_locked(folder):
        return "running", None
    facts = read_facts(folder)
    state = facts.get("state")
    if state == "running":
        return "failed", "the process was killed"
    if state == "failed":
        return "failed", cut(str(facts.get("reason") or "unknown"))
    if state in ("finished", "stopped"):
        return state, None
    return ("finished" if has_final_evaluation(folder) else "stopped"), None


def moment_of(evaluation: Evaluation) -> tuple[int, int]:
    """When a run was evaluated: its frames, or its updates where it has collected none."""
    return evaluation.env_frames, 0 if evaluation.env_frames else evaluation.updates


def _is_whole(entry: Mapping[str, Any]) -> bool:
    return all(isinstance(entry.get(name), int | float) for name in Evaluation._fields)


def has_final_evaluation(folder: Path) -> bool:
    """Whether the run was evaluated finally after the last frames that it has collected."""
    try:
        return bool(read_facts(folder, FINAL_FILE)["env_frames"] >= read_progress(folder)["env_frames"])
    except (KeyError, TypeError):
        return False


def is_locked(folder: Path) -> bool:
    """Whether a process holds the lock of a folder; false on a file system without locks."""
    try:
        lock = os.open(folder / LOCK_FILE, os.O_RDONLY | os.O_NONBLOCK)
    except OSError:
        return False
    try:
        fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    finally:
        os.close(lock)
    return False


def _read_metrics(path: Path) -> Iterator[Evaluation]:
    """The evaluations of a file of metrics, whose columns `actor` and `value` are losses."""
    for row in read_rows(path):
        frames = int(row["env_frames"])
        if row["planner_return"]:
            yield _to_evaluation(frames, row["minutes"], row["planner_return"], row["actor_return"], row["updates"])


def _to_evaluation(env_frames: Any, minutes: Any, planner: Any, actor: Any, updates: Any) -> Evaluation:
    return Evaluation(int(env_frames), float(minutes), float(planner), float(actor), int(updates))
