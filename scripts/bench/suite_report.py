"""The report of `benchmark.py suite` in Markdown, with its plots beside it."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from urllib.parse import quote

import numpy as np

from bench.estimates import Estimate, mean_estimate
from bench.report import format_number, write_text
from bench.suite_plot import plot_curves, plot_profile
from bench.suite_rows import JOINED, Row
from bench.suite_scores import (
    LARGEST_RETURN,
    Curves,
    aggregate,
    completed,
    counted,
    improvement,
    newest_curves,
    published_frames,
    published_scores,
    rows_at,
    score_matrix,
    task_means,
)
from latentplan.config import UserError
from latentplan.reporting.published import METHODS_AT_REPEAT_2, published_returns_of

MODES = ("planner", "actor")
SHOWN_FRAMES = (100_000, 200_000)  # of published returns in the table of tasks
ABOUT_METHODS = (
    "Of a published method only the mean over its seeds is known on each task. The means and interquartile means of "
    "this table are therefore over the means of tasks, on the tasks that both have. The probability of improvement is "
    "that of one run of the planner over the mean of the method: the share of a task's runs that earn more, averaged "
    "over tasks. Its interval resamples the runs of the planner only."
)
Results = Mapping[str, Mapping[int, Row]]


def write_report(rows: Sequence[Row], frames: int, path: Path) -> None:
    """Writes tables of the rows at a number of frames, and the plots `<name>-curves.png` and `<name>-profile.png`.

    Args:
        rows: Rows of results; of a task and seed, those of the newest version count.
        frames: Simulator frames at which returns are compared.
        path: The Markdown file.

    Raises:
        UserError: No run has a row within these frames, or a file cannot be written.
    """
    curves = newest_curves(rows)
    results = rows_at(curves, frames)
    if not results:
        raise UserError(f"no run has an evaluation within {frames:,} frames; give more --frames or other --tasks")
    reached = completed(results, frames)
    figures = {kind: path.with_name(f"{path.stem}-{kind}.png") for kind in ("curves", "profile")}
    parts = [f"# Suite at {frames:,} frames", _describe_runs(curves, results, frames)]
    parts += [_describe_table(frames), task_table(results, frames)]
    if reached:
        rows_that_count, tasks = counted(reached), list(reached)
        parts += _describe_all(rows_that_count, [len(rows) for rows in reached.values()], frames)
        own = {mode: score_matrix(rows_that_count, tasks, mode) for mode in MODES}
        plot_profile(own, _methods_with(tasks, published_frames(frames)), figures["profile"])
        parts += ["## Performance profile", _describe_profile(tasks, frames), _picture("profile", figures["profile"])]
    plot_curves(curves, figures["curves"])
    parts += [
        "## Learning curves",
        "Each line is one seed. Marks are published means.",
        _picture("curves", figures["curves"]),
    ]
    write_text(path, "\n\n".join(parts) + "\n")


def task_table(results: Results, frames: int) -> str:
    """One row per task: returns of planner and actor, and published returns beside them, as Markdown."""
    methods = [name for name in METHODS_AT_REPEAT_2 if any(_shown_returns(task, name) for task in results)]
    table = []
    for task, runs in results.items():
        rows = list(runs.values())
        best = _best_published(task, published_frames(frames))
        means = [_describe_mean([getattr(row, mode) for row in rows], best) for mode in MODES]
        spans = [_span([getattr(row, clock) for row in rows]) for clock in ("env_frames", "minutes")]
        published = [_shown_returns(task, name) for name in methods]
        table.append([task, spans[0], str(len(rows)), *means, spans[1], *published])
    return _markdown(["task", "frames", "seeds", *MODES, "minutes", *methods], table)


def aggregate_table(reached: Mapping[str, Sequence[Row]]) -> str:
    """Statistics of planner and actor over all tasks, as Markdown."""
    estimates = {mode: aggregate(score_matrix(reached, list(reached), mode)) for mode in MODES}
    names = list(estimates[MODES[0]])
    rows = [[name, *(_describe(estimates[mode][name], LARGEST_RETURN, 0) for mode in MODES)] for name in names]
    return _markdown(["over all tasks", *MODES], rows)


def method_table(reached: Mapping[str, Sequence[Row]], frames: int) -> str:
    """The planner against each published method on the tasks that both have, as Markdown."""
    known, rows = published_frames(frames), []
    has_intervals = min(map(len, reached.values())) > 1
    for method in METHODS_AT_REPEAT_2:
        tasks = [task for task in reached if known in published_returns_of(task).get(method, {})]
        if tasks:
            own, other = score_matrix(reached, tasks, "planner"), published_scores(method, tasks, known)
            ours, theirs = aggregate(task_means(own)), aggregate(other)
            pairs = [(ours[name].mean, theirs[name].mean) for name in ("mean", "interquartile mean")]
            cells = [" / ".join(format_number(LARGEST_RETURN * mean, 0) for mean in pair) for pair in pairs]
            chance = improvement(own, other)
            chance = chance if has_intervals else chance._replace(low=None, high=None)
            rows.append([method, str(len(tasks)), *cells, _describe(chance, 1.0, 2)])
    header = ["method", "tasks", "mean, planner / method", "interquartile mean, planner / method"]
    return _markdown([*header, "probability of improvement"], rows)


def _describe_runs(curves: Curves, results: Results, frames: int) -> str:
    runs = [row for each in results.values() for row in each.values()]
    versions, hardware, commits = (
        sorted({part for row in runs for part in getattr(row, name).split(JOINED)})
        for name in ("version", "hardware", "commit")
    )
    hours = sum(row.minutes for row in runs) / 60.0
    lines = [
        f"{len(runs)} runs of {len(results)} tasks took {hours:,.1f} hours, the time of each run counted alone. "
        f"Version {', '.join(versions)} of latentplan trained them, commit {', '.join(commits)}, on: "
        f"{'; '.join(hardware)}."
    ]
    reached = completed(results, frames)
    early = [
        f"{row.task}, seed {row.seed} ({row.env_frames:,})" for row in runs if row not in reached.get(row.task, [])
    ]
    if early:
        lines.append(f"Runs below {frames:,} frames count in the table of tasks only: {'; '.join(early)}.")
    later = [task for task in curves if task not in results]
    if later:
        lines.append(f"Tasks without an evaluation within {frames:,} frames: {', '.join(later)}.")
    return "\n".join(lines)


def _describe_table(frames: int) -> str:
    shown = " / ".join(f"{number:,}" for number in SHOWN_FRAMES)
    return (
        f"Planner and actor are returns of the last evaluation within {frames:,} frames, as the mean over seeds, with "
        "Student's 95 % interval where there are several seeds. Published returns are means over seeds at "
        f"{shown} frames, with action repeat 2; `latentplan/reporting/published.csv` has their sources. **Bold**: at "
        f"least as high as each of these methods at {published_frames(frames):,} frames."
    )


def _describe_all(reached: Mapping[str, Sequence[Row]], counts: Sequence[int], frames: int) -> list[str]:
    """Tables over all tasks, from the rows that count; `counts` are the runs of the tasks."""
    num_runs = min(counts)
    if num_runs == 1:
        several = f", by the mean of its runs where it has several (tasks: {sum(count > 1 for count in counts)})"
        bounds = (
            f"Each task counts once{several if max(counts) > 1 else ''}; without a second seed of every task there are "
            "no intervals."
        )
    else:
        bounds = (
            f"{num_runs} runs per task count, and brackets are 95 % stratified bootstrap intervals by `rliable`, which "
            "resample the runs of each task." + (" Of so few runs they are too narrow." if num_runs < 5 else "")
        )
    better = improvement(*(score_matrix(reached, list(reached), mode) for mode in MODES))
    return [
        "## All tasks together",
        f"Returns of the {len(reached)} tasks with a run of {frames:,} frames. {bounds}",
        aggregate_table(reached),
        f"The probability that a run's planner earns more than a run's actor is {_describe(better, 1.0, 2)}.",
        f"## Against published methods at {published_frames(frames):,} frames",
        ABOUT_METHODS,
        method_table(reached, frames),
    ]


def _describe_profile(tasks: Sequence[str], frames: int) -> str:
    known = published_frames(frames)
    absent = [name for name in METHODS_AT_REPEAT_2 if name not in _methods_with(tasks, known)]
    text = (
        "The share of a task's runs whose return is above a threshold, averaged over tasks. Of published methods it is "
        f"the share of tasks, by their means at {known:,} frames."
    )
    return text + (
        f" Methods without a result on some of these tasks are absent: {', '.join(absent)}." if absent else ""
    )


def _methods_with(tasks: Sequence[str], known: int) -> dict[str, np.ndarray]:
    """Mean scores of the methods that have a result on each of these tasks."""
    scores = {method: published_scores(method, tasks, known) for method in METHODS_AT_REPEAT_2}
    return {method: values for method, values in scores.items() if not np.isnan(values).any()}


def _best_published(task: str, frames: int) -> float:
    """The highest mean of the methods with action repeat 2 at these frames; infinite without any."""
    known = published_returns_of(task)
    means = [known[name][frames] for name in METHODS_AT_REPEAT_2 if frames in known.get(name, {})]
    return max(means, default=math.inf)


def _shown_returns(task: str, method: str) -> str:
    known = published_returns_of(task).get(method, {})
    if not any(frames in known for frames in SHOWN_FRAMES):
        return ""
    return " / ".join(format_number(known.get(frames), 0) for frames in SHOWN_FRAMES)


def _describe_mean(returns: Sequence[float], best: float) -> str:
    estimate = mean_estimate(returns)
    if estimate.low is not None and estimate.high is not None:  # a return lies between 0 and 1,000
        estimate = estimate._replace(low=max(0.0, estimate.low), high=min(LARGEST_RETURN, estimate.high))
    text = _describe(estimate, 1.0, 0)
    mean, _, rest = text.partition(" ")
    return f"**{mean}** {rest}".strip() if estimate.mean >= best else text


def _describe(estimate: Estimate, scale: float, digits: int) -> str:
    """A mean, with its interval in brackets where it has one."""
    mean, low, high = (None if value is None else scale * value for value in estimate)
    text = format_number(mean, digits)
    return text if low is None else f"{text} ({format_number(low, digits)} to {format_number(high, digits)})"


def _span(values: Sequence[float]) -> str:
    low, high = (format_number(value, 0) for value in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"


def _markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *([cell or "-" for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _picture(kind: str, png: Path) -> str:
    words = {"curves": "Evaluation returns against frames", "profile": "Share of runs above each return"}
    return f"![{words[kind]}]({quote(os.fsencode(png.name))})"
