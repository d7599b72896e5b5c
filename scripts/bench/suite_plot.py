"""Plots of `benchmark.py suite`: learning curves of every task, and the performance profile."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bench.learn_plot import mark_published
from bench.report import save_figure
from bench.suite_rows import Row
from bench.suite_scores import LARGEST_RETURN, TOLERANCE, Curves, Scores, profile
from latentplan.reporting.published import METHODS_AT_REPEAT_2

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

STYLES = {"planner": ("#1f6fb4", "-"), "actor": ("#d9791a", "--")}
COLUMNS = 3
NUM_THRESHOLDS = 201
COLORS = dict(
    zip(
        METHODS_AT_REPEAT_2,
        ("#2a9d5c", "#8e5ea2", "#111111", "#b5443c", "#8a8a8a", "#c2a01f", "#d46a9f"),
        strict=True,
    )
)


def plot_curves(curves: Curves, png: Path) -> None:
    """Draws evaluation returns against env frames: one panel per task, one line per seed for planner and actor."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter, MaxNLocator

    columns = min(COLUMNS, len(curves))
    rows = -(-len(curves) // columns)
    figure = Figure(figsize=(max(2.6 * columns, 5.0), 2.0 * rows + 0.9), layout="constrained")
    entries: dict[str, Artist] = {}
    for place, (task, runs) in enumerate(curves.items(), start=1):
        axes = figure.add_subplot(rows, columns, place)
        _draw_runs(axes, list(runs.values()))
        last = max(rows[-1].env_frames for rows in runs.values())
        mark_published(axes, task, (1.0 + TOLERANCE) * last, COLORS)
        axes.set_title(task, fontsize="medium")
        axes.set(xlim=(0.0, 1.1 * last), ylim=(min(0.0, axes.get_ylim()[0]), None))
        if place > len(curves) - columns:  # the lowest panel of a column
            axes.set_xlabel("environment frames")
        axes.xaxis.set_major_locator(MaxNLocator(3))
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.grid(alpha=0.25)
        entries |= {label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.supylabel("evaluation return, at most 1,000", fontsize="medium")
    figure.legend(
        list(entries.values()), list(entries), loc="outside lower center", ncols=min(5, 2 * columns), fontsize="small"
    )
    save_figure(figure, png)


def plot_profile(own: Mapping[str, Scores], published: Mapping[str, Scores], png: Path) -> None:
    """Draws the share of a task's runs with a return above each threshold, averaged over tasks.

    Args:
        own: Scores of planner and actor, (run, task).
        published: Mean scores of methods that have a result on each of these tasks, (1, task).
        png: Path of the figure.
    """
    from matplotlib.figure import Figure

    thresholds = np.linspace(0.0, 1.0, NUM_THRESHOLDS)
    figure = Figure(figsize=(7.5, 4.5), layout="constrained")
    axes = figure.add_subplot()
    for name, scores in published.items():
        share, *_ = profile(scores, thresholds)
        axes.step(LARGEST_RETURN * thresholds, share, where="post", color=COLORS[name], linewidth=1.0, label=name)
    for mode, scores in own.items():
        color, style = STYLES[mode]
        share, low, high = profile(scores, thresholds)
        axes.step(LARGEST_RETURN * thresholds, share, style, where="post", color=color, linewidth=2.0, label=mode)
        if low is not None and high is not None:
            axes.fill_between(LARGEST_RETURN * thresholds, low, high, step="post", color=color, alpha=0.15)
    axes.set(xlabel="return", ylabel="share of runs with a higher return", xlim=(0.0, LARGEST_RETURN), ylim=(0.0, 1.02))
    axes.grid(alpha=0.25)
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize="small")
    save_figure(figure, png)


def _draw_runs(axes: Axes, runs: Sequence[Sequence[Row]]) -> None:
    """Draws planner and actor of each run; the first run alone names them in the legend."""
    for number, rows in enumerate(runs):
        frames = [row.env_frames for row in rows]
        for mode, (color, style) in STYLES.items():
            returns = [getattr(row, mode) for row in rows]
            shown = mode if number == 0 else None
            axes.plot(frames, returns, style, color=color, marker="o", markersize=2.5, linewidth=1.2, label=shown)
