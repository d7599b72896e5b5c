"""Milliseconds of the project's planner by the size of the search, for `benchmark.py plan --scaling`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

from bench.peers.problem import Problem
from bench.plan_searches import planner_search, timed
from bench.report import format_number, format_table, save_figure

FACTORS = (0.25, 0.5, 1.0, 2.0, 4.0)  # multiples of the requested samples, horizon and iterations
BATCHES = (1, 4, 16, 64)
ROUNDS = 3
AXES = ("samples", "horizon", "iterations", "environments")


def measure_scaling(problem: Problem, dtype: str) -> list[dict[str, Any]]:
    """Median milliseconds of a search along each axis, the other sizes as in `problem`.

    Returns:
        One row per point: `axis`, `value`, `p50_ms` (median milliseconds), and `of_linear` (the time as a share of the
        time under linear growth from the first point of the axis).
    """
    points = [(axis, value) for axis in AXES[:-1] for value in _values(getattr(problem, axis))]
    points += [("environments", batch) for batch in BATCHES]
    searches = [timed(_search_at(problem, dtype, *point), problem) for point in points]
    for search_ms in searches:
        search_ms()
    laps = [[search_ms() for search_ms in searches] for _ in range(ROUNDS)]
    p50 = [median(times) for times in zip(*laps, strict=True)]
    first: dict[str, float] = {}  # milliseconds per unit at the axis's first point
    rows = []
    for (axis, value), elapsed in zip(points, p50, strict=True):
        linear = first.setdefault(axis, elapsed / value) * value
        rows.append({"axis": axis, "value": value, "p50_ms": elapsed, "of_linear": elapsed / linear})
    return rows


def scaling_table(rows: Sequence[dict[str, Any]]) -> str:
    """The points as a text table."""
    lines = [
        [row["axis"], f"{row['value']:,}", format_number(row["p50_ms"]), format_number(row["of_linear"], 2)]
        for row in rows
    ]
    return format_table(["along", "value", "p50 ms", "of linear"], lines)


def plot_scaling(rows: Sequence[dict[str, Any]], png: Path) -> None:
    """Draws one panel per axis, with a dotted line of linear growth."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 3.4), layout="constrained")
    for axes, axis in zip(figure.subplots(1, len(AXES), sharey=True), AXES, strict=True):
        chosen = [row for row in rows if row["axis"] == axis]
        values = [row["value"] for row in chosen]
        linear = [row["p50_ms"] / row["of_linear"] for row in chosen]
        axes.loglog(values, linear, ":", color="0.6", label="linear")
        axes.loglog(values, [row["p50_ms"] for row in chosen], "o-", color="#1f6fb4", label="measured")
        axes.set_xticks(values, [str(value) for value in values], minor=False)
        axes.set_xticks([], minor=True)
        axes.set_xlabel(axis)
        axes.grid(alpha=0.3)
    figure.axes[0].set_ylabel("milliseconds per search")
    figure.axes[0].legend(frameon=False)
    save_figure(figure, png)


def _values(base: int) -> list[int]:
    return sorted({max(2, round(factor * base)) for factor in FACTORS})


def _search_at(problem: Problem, dtype: str, axis: str, value: int) -> Any:
    if axis == "environments":
        return planner_search(problem, dtype, value)
    changes: dict[str, Any] = {axis: value}
    return planner_search(replace(problem, **changes), dtype)
