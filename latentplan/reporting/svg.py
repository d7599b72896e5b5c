"""Matplotlib figures as SVG for web pages: text stays text, and colours follow the theme of the page."""

from __future__ import annotations

import html
import io
import itertools
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from numpy.typing import ArrayLike, NDArray

INK, FAINT = "#010203", "#010204"
COLORS = ("#0102f1", "#0102f2", "#0102f3", "#0102f4", "#0102f5", "#0102f6")  # stand for colours of the page's theme
DASHES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1)), (0, (1, 1)))
_THEMED = {INK: "var(--ink)", FAINT: "var(--faint)"} | {
    color: f"var(--series-{index + 1})" for index, color in enumerate(COLORS)
}
_STYLE: Any = {
    "svg.fonttype": "none",
    "text.parse_math": False,  # names hold dollar signs as they are
    "font.size": 9.0,
    "font.family": "sans-serif",
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": FAINT,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "path.simplify": True,
    "path.simplify_threshold": 1.0,
}
_SIZE = (4.1, 2.7)  # inches: on a phone of 400 pixels a figure is shown at its own size
_numbers = itertools.count()


@dataclass(frozen=True)
class Line:
    """A line of a figure.

    Attributes:
        name: Name in the legend; empty for none.
        x: Places, (point,).
        y: Values, (point,).
        low: Lower ends of the values' interval, (point,); None without an interval.
        high: Upper ends.
        style: How matplotlib draws the line, such as "-" or "o"; None takes the next kind of dashes.
    """

    name: str
    x: ArrayLike
    y: ArrayLike
    low: ArrayLike | None = None
    high: ArrayLike | None = None
    style: str | None = None


@dataclass(frozen=True)
class Labels:
    """What stands at a figure.

    Attributes:
        alt: What the figure shows, for those who do not see it.
        x: Label of the x axis, with its unit.
        y: Label of the y axis, with its unit.
        levels: Horizontal lines, each with its name.
        marks: Vertical lines, each with its name.
    """

    alt: str
    x: str
    y: str
    levels: Sequence[tuple[str, float]] = field(default=())
    marks: Sequence[tuple[str, float]] = field(default=())


def plot_lines(lines: Sequence[Line], labels: Labels, *, large_x: bool = False, whole_x: bool = False) -> str:
    """Lines with their intervals, as SVG; NaN leaves a gap in a line.

    A point without a neighbour, which no line would show, is a dot, and its interval is a bar.

    Args:
        lines: The lines, at most six with a colour of their own.
        labels: Labels of the figure.
        large_x: Whether the x axis counts in thousands (k) and millions (M).
        whole_x: Whether only whole numbers stand at the x axis.
    """

    def draw(axes: Axes) -> None:
        for index, line in enumerate(lines):
            color, style = COLORS[index % len(COLORS)], line.style or DASHES[index % len(DASHES)]
            if line.style == "o":
                axes.plot(line.x, line.y, "o", color=color, markersize=3, label=_legend_name(line.name))
                continue
            axes.plot(line.x, line.y, ls=style, lw=1.4, color=color, label=_legend_name(line.name))
            x, y = np.asarray(line.x, float), np.asarray(line.y, float)
            is_alone = _find_lone_points(y)
            axes.plot(x[is_alone], y[is_alone], "o", color=color, markersize=3)
            if line.low is not None and line.high is not None:
                low, high = np.asarray(line.low, float), np.asarray(line.high, float)
                axes.fill_between(x, low, high, color=color, alpha=0.2, lw=0)
                axes.vlines(x[is_alone], low[is_alone], high[is_alone], color=color, lw=1.4)
        if large_x:
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        if whole_x:
            axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))

    return _draw(draw, labels)


def _find_lone_points(values: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Where a finite value has no finite neighbour, (point,)."""
    is_finite = np.pad(np.isfinite(values), 1)
    lone: NDArray[np.bool_] = is_finite[1:-1] & ~is_finite[:-2] & ~is_finite[2:]
    return lone


def plot_histogram(values: Sequence[tuple[str, ArrayLike]], labels: Labels, bins: Sequence[float]) -> str:
    """Histograms over each other, each with its name, as SVG."""

    def draw(axes: Axes) -> None:
        for index, (name, each) in enumerate(values):
            axes.hist(each, bins=bins, color=COLORS[index], alpha=0.6, label=_legend_name(name))

    return _draw(draw, labels)


def plot_fan(candidates: ArrayLike, elites: ArrayLike, mean: ArrayLike, labels: Labels) -> str:
    """Sequences of one action dimension over the steps of a plan, from 1, as SVG.

    Args:
        candidates: Candidates that are no elites, (sample, horizon).
        elites: Elites, (elite, horizon).
        mean: Mean of the search distribution after the iteration, (horizon,).
        labels: Labels of the figure.
    """

    def draw(axes: Axes) -> None:
        for index, (name, rows, alpha) in enumerate((("candidates", candidates, 0.25), ("elites", elites, 0.7))):
            paths = [list(enumerate(row, start=1)) for row in np.asarray(rows)]
            color = (FAINT, COLORS[0])[index]
            axes.add_collection(LineCollection(paths, colors=color, alpha=alpha, linewidths=0.7, label=name))
        steps = np.arange(1, len(np.asarray(mean)) + 1)
        axes.plot(steps, mean, color=COLORS[1], lw=1.8, label="mean")
        axes.set_ylim(-1.08, 1.08)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))

    return _draw(draw, labels)


def _draw(draw: Callable[[Axes], None], labels: Labels) -> str:
    """A figure of one panel, with its legend above the panel."""
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=_SIZE, layout="constrained")
        axes = figure.add_subplot()
        draw(axes)
        for index, (name, value) in enumerate(labels.levels):
            axes.axhline(value, color=FAINT, lw=1.0, ls=DASHES[(index + 1) % len(DASHES)], label=_legend_name(name))
        for index, (name, value) in enumerate(labels.marks):
            axes.axvline(value, color=INK, lw=1.2, ls=DASHES[(index + 1) % len(DASHES)], label=_legend_name(name))
        axes.set_xlabel(labels.x)
        axes.set_ylabel(labels.y)
        axes.grid(color=FAINT, alpha=0.25, lw=0.5)
        handles, names = axes.get_legend_handles_labels()
        if names:
            columns = 3 if max(map(len, names)) < 14 else 2 if max(map(len, names)) < 24 else 1
            legend = figure.legend(
                handles, names, loc="outside upper left", ncols=columns, fontsize=8, handlelength=1.8
            )
            for handle in legend.legend_handles:
                if handle is not None:
                    handle.set_alpha(1.0)
        return _to_svg(figure, labels.alt)


def _legend_name(name: str) -> str | None:
    """The name as a legend shows it; None for none. Matplotlib leaves out names that begin with an underscore."""
    shown = name.encode("utf-8", "backslashreplace").decode()
    return f" {shown}" if shown.startswith("_") else shown or None


def _to_svg(figure: Figure, alt: str) -> str:
    """A figure as the element `svg`, whose names do not meet those of other figures of a page."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    number = next(_numbers)
    text = re.sub(r'(\bid="|url\(#|xlink:href="#)', rf"\g<1>f{number}-", text)
    for color, variable in _THEMED.items():
        text = text.replace(color, variable)
    text = re.sub(r"\n\s*", "\n", text)
    return text.replace("<svg", f'<svg role="img" aria-label="{html.escape(alt)}"', 1)
