"""Learning curves: evaluation returns of planner and actor over a run."""

from __future__ import annotations

import csv
import os
from pathlib import Path
from typing import TYPE_CHECKING

from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from latentplan.config.writing import replaced_whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CURVES = {"planner_return": ("planner", "#1f6fb4", "-"), "actor_return": ("actor", "#d9791a", "--")}
CLOCKS = {"env_frames": "environment frames", "minutes": "minutes"}


def read_curve(metrics_csv: str | os.PathLike[str], clock: str, column: str) -> tuple[list[float], list[float]]:
    """Times and values of one column of a metrics file, from the rows with a value in both columns.

    Args:
        metrics_csv: Metrics of a run.
        clock: Name of the column with the times.
        column: Name of the column with the values.

    Raises:
        ValueError: The file lacks one of the two columns; the message names the existing columns.
    """
    with open(metrics_csv, newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        for name in (clock, column):
            if name not in (reader.fieldnames or ()):
                raise ValueError(f"{metrics_csv} has no column {name!r}; it has: {', '.join(reader.fieldnames or ())}")
        rows = [(float(row[clock]), float(row[column])) for row in reader if row[clock] and row[column]]
    return [time for time, _ in rows], [value for _, value in rows]


def plot_curves(metrics_csv: str | os.PathLike[str], png: str | os.PathLike[str]) -> Path:
    """Draws the evaluation return of planner and actor, against environment frames and against minutes.

    Args:
        metrics_csv: Metrics of a run, with columns `env_frames`, `minutes`, `planner_return` and `actor_return`; cells
            without a measurement are empty.
        png: Path of the figure.

    Returns:
        The path of the figure.

    Raises:
        ValueError: A column is missing.
    """
    figure = Figure(figsize=(10, 4), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    for axes, (clock, label) in zip(panels, CLOCKS.items(), strict=True):
        _draw(axes, metrics_csv, clock)
        axes.set_xlabel(label)
    panels[0].set_ylabel("evaluation return")
    panels[0].legend(loc="upper left", frameon=False)
    return save_figure(figure, png)


def save_figure(figure: Figure, png: str | os.PathLike[str]) -> Path:
    """Writes a figure as PNG in place of a file, and returns the path."""
    path = Path(png)
    with replaced_whole(path) as part:
        figure.savefig(part, dpi=120, format="png")
    return path


def _draw(axes: Axes, metrics_csv: str | os.PathLike[str], clock: str) -> None:
    for column, (name, color, style) in CURVES.items():
        times, values = read_curve(metrics_csv, clock, column)
        axes.plot(times, values, style, color=color, marker="o", markersize=3, label=name)
    axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
    axes.margins(x=0.02)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
