"""Returns of a suite at one number of frames, and their statistics over tasks and seeds (Agarwal et al. 2021).

Scores are returns divided by 1,000, float64 (run, task), with NaN below the last run of a task that has fewer runs than
another; `rliable` resamples the runs of each task.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import zip_longest
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.estimates import NUM_RESAMPLES, Estimate, interquartile_mean
from bench.suite_rows import Row
from latentplan.config.extras import import_extra
from latentplan.reporting.published import FRAMES, published_returns_of

Scores = NDArray[np.float64]
Curves = dict[str, dict[int, list[Row]]]
LARGEST_RETURN = 1000.0
TOLERANCE = 0.03  # a run that ends this share of its frames early or late counts as one of these frames
AGGREGATES: dict[str, Callable[[Scores], float]] = {
    "mean": lambda scores: float(scores.mean()),
    "interquartile mean": lambda scores: interquartile_mean(scores.ravel().tolist()),
    "median of the tasks": lambda scores: float(np.median(scores.mean(axis=0))),
}


def newest_curves(rows: Iterable[Row]) -> Curves:
    """The rows of each run of the newest version that trained its task and seed, by task and seed, in order."""
    groups: dict[tuple[str, int], dict[str, list[Row]]] = {}
    for row in sorted(rows, key=lambda row: (row.task, row.seed, row.env_frames)):
        groups.setdefault((row.task, row.seed), {}).setdefault(row.version, []).append(row)
    curves: Curves = {}
    for (task, seed), versions in groups.items():
        curves.setdefault(task, {})[seed] = versions[max(versions, key=_version_numbers)]
    return curves


def rows_at(curves: Curves, frames: int) -> dict[str, dict[int, Row]]:
    """The last row of each run within a number of frames, by task and seed; without runs that begin later."""
    found: dict[str, dict[int, Row]] = {}
    for task, runs in curves.items():
        for seed, rows in runs.items():
            within = [row for row in rows if row.env_frames <= (1.0 + TOLERANCE) * frames]
            if within:
                found.setdefault(task, {})[seed] = within[-1]
    return found


def completed(results: Mapping[str, Mapping[int, Row]], frames: int) -> dict[str, list[Row]]:
    """By task, the rows of the runs that have reached a number of frames; without tasks that have no such run."""
    least = (1.0 - TOLERANCE) * frames
    reached = {
        task: [row for _, row in sorted(runs.items()) if row.env_frames >= least] for task, runs in results.items()
    }
    return {task: rows for task, rows in reached.items() if rows}


def counted(reached: Mapping[str, Sequence[Row]]) -> dict[str, list[Row]]:
    """The rows that count in statistics over all tasks.

    Args:
        reached: By task, a row of each of its runs, at least one.

    Returns:
        Where each task has several runs, the first rows of a task, as many as the task with the fewest has. Else all.
    """
    num_runs = min(map(len, reached.values()))
    return {task: list(rows[: num_runs if num_runs > 1 else None]) for task, rows in reached.items()}


def score_matrix(rows: Mapping[str, Sequence[Row]], tasks: Sequence[str], mode: str) -> Scores:
    """Scores of planner or actor, (run, task)."""
    returns = [[getattr(row, mode) for row in rows[task]] for task in tasks]
    return np.array(list(zip_longest(*returns, fillvalue=np.nan)), float) / LARGEST_RETURN


def task_means(scores: Scores) -> Scores:
    """The mean of the runs of each task as one run, (1, task)."""
    return np.nanmean(scores, axis=0, keepdims=True)


def published_scores(method: str, tasks: Sequence[str], frames: int) -> Scores:
    """Mean scores of a published method as one run, (1, task); NaN for a task without a result at these frames."""
    means = [published_returns_of(task).get(method, {}).get(frames, np.nan) for task in tasks]
    return np.array([means], float) / LARGEST_RETURN


def published_frames(frames: int) -> int:
    """The number of frames whose published returns are compared with own ones: the next that is not smaller."""
    return next((known for known in FRAMES if known >= (1.0 - TOLERANCE) * frames), FRAMES[-1])


def aggregate(scores: Scores) -> dict[str, Estimate]:
    """The statistics in `AGGREGATES` with stratified bootstrap intervals; without intervals for one run per task.

    Where tasks have unequal numbers of runs, each counts by the mean of its runs, without intervals.
    """
    scores = task_means(scores) if np.isnan(scores).any() else scores

    def compute(values: Scores) -> Scores:
        return np.array([function(values) for function in AGGREGATES.values()])

    means, low, high = _estimate(scores, compute)
    return {name: Estimate(*ends) for name, *ends in zip(AGGREGATES, means, low, high, strict=True)}


def improvement(scores: Scores, others: Scores) -> Estimate:
    """Probability that a run has a higher score than one of the others, averaged over tasks; a tie counts half.

    Args:
        scores: Scores, (run, task).
        others: Scores of the others, (run, task); one run where only means are known.

    Returns:
        The probability with its interval, for which the runs of either side are resampled; no interval where a task
        has one run.
    """

    def compute(ours: Scores, theirs: Scores) -> Scores:
        wins = 0.5 + 0.5 * np.sign(ours[:, None] - theirs[None])  # (run, other run, task)
        return np.array([np.nanmean(wins, axis=(0, 1)).mean()])

    return Estimate(*(ends[0] for ends in _estimate([scores, others], compute)))


def profile(scores: Scores, thresholds: Scores) -> tuple[Scores, Scores | None, Scores | None]:
    """Share of a task's runs with a score above each threshold (threshold,), mean over tasks; ends of its interval."""

    def compute(values: Scores) -> Scores:
        values = values[:, :, None]  # (run, task, threshold)
        above = np.where(np.isnan(values), np.nan, values > thresholds)
        return np.array(np.nanmean(above, axis=0).mean(axis=0))

    share, low, high = _estimate(scores, compute)
    return (share, None, None) if low[0] is None else (share, low, high)


def _estimate(scores: Scores | list[Scores], compute: Callable[..., Scores]) -> tuple[Any, Any, Any]:
    """Values and the ends of their 95 % intervals; ends are None where a task has one run, which has no spread."""
    arrays = scores if isinstance(scores, list) else [scores]
    values = compute(*arrays)
    if len(arrays[0]) == 1 or np.isnan(arrays[0]).any():
        return values, [None] * len(values), [None] * len(values)
    library = import_extra("rliable.library", "the report")
    with _seeded():
        _, intervals = library.get_interval_estimates({"all": scores}, compute, reps=NUM_RESAMPLES)
    return values, *intervals["all"]


@contextlib.contextmanager
def _seeded() -> Iterator[None]:
    """Makes the global random numbers of NumPy, from which `rliable` draws, the same every time."""
    before = np.random.get_state()
    np.random.seed(0)
    try:
        yield
    finally:
        np.random.set_state(before)


def _version_numbers(version: str) -> tuple[int, ...]:
    return tuple(map(int, re.findall(r"\d+", version)))
