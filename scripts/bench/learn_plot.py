"""Learning curves of `benchmark.py learn`, and their figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from bench.report import save_figure
from latentplan.reporting.published import METHODS, published_returns_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MARKERS = "D^8svd<>PX*hp"  # one marker for each method in METHODS


class Point(NamedTuple):
    """One evaluation of a run."""

    env_frames: float
    minutes: float
    total_return: float


class Curve(NamedTuple):
    """The evaluations of one run, in order."""

    task: str
    seed: int
    points: list[Point]


def plot_runs(curves: Sequence[Curve], mode: str, png: Path) -> None:
    """Draws evaluation returns against env frames: one panel per task, two in a row, one line per seed."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter

    tasks = list(dict.fromkeys(curve.task for curve in curves))
    rows, columns = (len(tasks) + 1) // 2, min(2, len(tasks))
    figure = Figure(figsize=(6.5 * columns, 4 * rows), layout="constrained")
    for place, task in enumerate(tasks, start=1):
        axes = figure.add_subplot(rows, columns, place)
        for curve in (curve for curve in curves if curve.task == task):
            frames, _, returns = zip(*curve.points, strict=True)
            axes.plot(frames, returns, marker="o", markersize=3, label=f"seed {curve.seed}")
        mark_published(axes, task, axes.get_xlim()[1])
        axes.set(title=task, xlabel="environment frames", ylabel=f"evaluation return, {mode}")
        axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.grid(alpha=0.25)
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize="small")
    save_figure(figure, png)


def mark_published(axes: Axes, task: str, last: float, colors: Mapping[str, str] | None = None) -> None:
    """Marks published returns of a task at the env frames that a panel shows.

    Args:
        axes: The panel.
        task: The task as domain-task.
        last: Last env frames of the panel.
        colors: Colours of the methods to mark; None marks all methods in grey.
    """
    for method, known in published_returns_of(task).items():
        marker = MARKERS[METHODS.index(method)]
        shown = {frames: value for frames, value in known.items() if frames <= last}
        if shown and (colors is None or method in colors):
            color = "0.45" if colors is None else colors[method]
            axes.plot(*zip(*shown.items(), strict=True), marker, color=color, markersize=5, label=method)
