"""Figure of `benchmark.py realtime`: one panel per part that was measured."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from bench.report import save_figure

Rows = Sequence[Mapping[str, Any]]
BLUE, ORANGE = "#1f6fb4", "#d9730d"
AGENT_STYLES = {
    "planner": ("#1f6fb4", "o", "planner, blocking"),
    "deadline": ("#17a2a2", "s", "planner, deadline"),
    "background": ("#7b4fb3", "D", "background"),
    "gated": ("#2e8b3d", "^", "gated"),
    "actor": ("#d9730d", "v", "actor"),
}


def plot_realtime(result: Mapping[str, Rows], png: Path) -> None:
    """Draws the parts that have rows, in two columns.

    Args:
        result: Rows by part, as in the JSON.
        png: Path of the figure.
    """
    from matplotlib.figure import Figure

    panels: dict[str, Callable[[Any, Rows], None]] = {
        "rates": _draw_rates,
        "iterations": _draw_iterations,
        "error": _draw_error,
        "replan": _draw_replanning,
    }
    chosen = [(draw, result[part]) for part, draw in panels.items() if result.get(part)]
    if not chosen:
        return
    columns = min(2, len(chosen))
    lines = -(-len(chosen) // columns)
    figure = Figure(figsize=(6.0 * columns, 4.2 * lines), layout="constrained")
    grid = figure.subplots(lines, columns, squeeze=False).ravel()
    for axes, (draw, rows) in zip(grid, chosen, strict=False):
        draw(axes, rows)
        axes.grid(alpha=0.3)
    for axes in grid[len(chosen) :]:
        axes.set_visible(False)
    save_figure(figure, png)


def _draw_rates(axes: Any, rows: Rows) -> None:
    rates = sorted({row["control_hz"] for row in rows})
    for index, (name, (colour, marker, label)) in enumerate(AGENT_STYLES.items()):
        own = sorted((row for row in rows if row["agent"] == name), key=lambda row: row["control_hz"])
        if own:
            # A small shift per agent, so that the intervals of agents do not overlap.
            shift = 1.0 + 0.035 * (index - 2)
            _draw_returns(axes, [row["control_hz"] * shift for row in own], own, colour, marker, label)
    axes.set_xscale("log")
    axes.set_xticks(rates, [f"{rate:g}" for rate in rates], minor=False)
    axes.set_xticks([], minor=True)
    axes.set_xlabel("decisions per second of an environment that does not wait")
    axes.set_title("Return by control rate")
    axes.legend(frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=3, fontsize="small")


def _draw_iterations(axes: Any, rows: Rows) -> None:
    positions = list(range(len(rows)))
    _draw_returns(axes, positions, rows, BLUE, "o", "return")
    axes.set_xticks(positions, [row["iterations"] for row in rows])
    axes.set_xlim(-0.5, len(rows) - 0.5)
    axes.set_xlabel("iterations of each search")
    axes.set_title("Return and latency by iterations")
    latency = axes.twinx()
    latency.plot(positions, [row["decision_ms"]["p50"] for row in rows], "s--", color=ORANGE, label="latency")
    latency.set_ylim(bottom=0.0)
    latency.set_ylabel("median milliseconds per decision", color=ORANGE)
    axes.set_ylabel("return", color=BLUE)


def _draw_error(axes: Any, rows: Rows) -> None:
    steps = [row["step"] for row in rows]
    for name, colour, label in (("latent", BLUE, "latent distance"), ("reward", ORANGE, "reward error")):
        error = {"latent": "latent_distance", "reward": "reward_error"}[name]
        axes.plot(steps, [row[error] for row in rows], "o-", color=colour, markersize=4, label=label)
        unchanged = [row[f"{name}_change"] for row in rows]
        axes.plot(steps, unchanged, ":", color=colour, label=f"{name}, predicting no change")
    axes.set_yscale("log")
    axes.set_xticks([step for step in steps if step == 1 or step % 5 == 0])
    axes.set_xlabel("imagined step")
    axes.set_ylabel("mean error")
    axes.set_title("Prediction error")
    axes.legend(frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2, fontsize="small")


def _draw_replanning(axes: Any, rows: Rows) -> None:
    positions = list(range(len(rows)))
    _draw_returns(axes, positions, rows, BLUE, "o", "return")
    axes.set_xticks(positions, [f"{row['replan_every']}\n(horizon {row['horizon']})" for row in rows])
    axes.set_xlim(-0.5, len(rows) - 0.5)
    axes.set_xlabel("actions executed from each plan")
    axes.set_title("Return by re-planning")


def _draw_returns(axes: Any, positions: Sequence[float], rows: Rows, colour: str, marker: str, label: str) -> None:
    """Draws mean returns, with their intervals if there are any (a single episode has none)."""
    means = [row["mean_return"] for row in rows]
    axes.plot(positions, means, marker=marker, color=colour, label=label, linewidth=1.5, markersize=5)
    for position, row in zip(positions, rows, strict=True):
        if row["ci95"][0] is not None:
            axes.plot([position, position], row["ci95"], color=colour, alpha=0.35, linewidth=2)
    axes.set_ylabel("return")
