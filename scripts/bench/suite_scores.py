"""Returns of a suite at one number of frames, and their statistics over tasks and seeds (Agarwal et al. 2021).

Scores are returns divided by 1,000, float64 (run, task); `rliable` resamples the runs of each task.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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


def balanced(reached: Mapping[str, Sequence[Row]]) -> dict[str, list[Row]]:
    """As many rows of each task as of every other.

    Args:
        reached: By task, a row of each of its runs, at least one.

    Returns:
        Where each task has several runs, the first rows of a task, as many as the task with the fewest has. Else one
        row per task, with the mean returns of its runs.
    """
    num_runs = min(map(len, reached.values()))
    if num_runs > 1:
        return {task: list(rows[:num_runs]) for task, rows in reached.items()}
    return {task: [_averaged(rows)] for task, rows in reached.items()}


def score_matrix(rows: Mapping[str, Sequence[Row]], tasks: Sequence[str], mode: str) -> Scores:
    """Scores of planner or actor, (run, task), of as many runs of each task as of every other."""
    returns = [[getattr(row, mode) for row in rows[task]] for task in tasks]
    return np.array(returns, float).T / LARGEST_RETURN


def published_scores(method: str, tasks: Sequence[str], frames: int) -> Scores:
    """Mean scores of a published method as one run, (1, task); NaN for a task without a result at these frames."""
    means = [published_returns_of(task).get(method, {}).get(frames, np.nan) for task in tasks]
    return np.array([means], float) / LARGEST_RETURN


def published_frames(frames: int) -> int:
    """The number of frames whose published returns are compared with own ones: the next that is not smaller."""
    return next((known for known in FRAMES if known >= (1.0 - TOLERANCE) * frames), FRAMES[-1])


def aggregate(scores: Scores) -> dict[str, Estimate]:
    """The statistics in `AGGREGATES` with stratified bootstrap intervals; without intervals for one run per task."""

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
        The probability with its interval, for which the runs of either side are resampled; no interval for one run.
    """

    def compute(ours: Scores, theirs: Scores) -> Scores:
        difference = ours[:, None] - theirs[None]  # (run, other run, task)
        return np.array([np.mean((difference > 0) + 0.5 * (difference == 0))])

    return Estimate(*(ends[0] for ends in _estimate([scores, others], compute)))


def profile(scores: Scores, thresholds: Scores) -> tuple[Scores, Scores | None, Scores | None]:
    """Share of runs and tasks with a score above each threshold (threshold,), and the ends of its interval."""

    def compute(values: Scores) -> Scores:
        return np.array((values[:, :, None] > thresholds).mean(axis=(0, 1)))

    share, low, high = _estimate(scores, compute)
    return (share, None, None) if low[0] is None else (share, low, high)


def _averaged(rows: Sequence[Row]) -> Row:
    planner, actor = (float(np.mean([getattr(row, mode) for row in rows])) for mode in ("planner", "actor"))
    return rows[0]._replace(planner=planner, actor=actor)


def _estimate(scores: Scores | list[Scores], compute: Callable[..., Scores]) -> tuple[Any, Any, Any]:
    """Values and the ends of their 95 % intervals; ends are None where a task has one run, which has no spread."""
    arrays = scores if isinstance(scores, list) else [scores]
    values = compute(*arrays)
    if len(arrays[0]) == 1:
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
