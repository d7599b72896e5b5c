"""Training runs beside each other: groups of seeds, their mean curves, settings that differ, and the page of all."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from latentplan.config import UserError
from latentplan.config.run_results import comparable_settings, has_final_evaluation
from latentplan.reporting.page import LARGEST_FILM, Section, figure, film, render_page, table
from latentplan.reporting.published import published_returns_of
from latentplan.reporting.runs import RunSummary, format_return
from latentplan.reporting.svg import Labels, Line, plot_lines

Interval = Callable[[Sequence[float]], tuple[float, float]]
SEED = "run.seed"
NUM_POINTS = 60
MODES = ("planner", "actor")
CLOCKS = {"env_frames": "frames", "minutes": "minutes"}
OFFLINE_CLOCKS = {"updates": "updates", "minutes": "minutes"}  # of runs that have collected no frames


@dataclass(frozen=True)
class Group:
    """Runs that differ in their seeds alone.

    Attributes:
        name: Settings that tell the group from all others; the task where no setting differs. The folder of the runs
            follows where only folders tell two groups apart.
        task: The task as domain-task.
        runs: The runs, by seed.
    """

    name: str
    task: str
    runs: Sequence[RunSummary]


def group_runs(runs: Sequence[RunSummary]) -> tuple[list[Group], dict[str, list[Any]]]:
    """Runs in groups, in the order in which they were given, and the settings that differ.

    Runs that repeat the settings and the seed of another run are no further seed: the runs of these settings make one
    group for each folder that holds them.

    Returns:
        The groups; by setting that differs between groups, the value in each group.

    Raises:
        UserError: Two runs of one folder have the same settings and the same seed.
    """
    alike: list[tuple[dict[str, Any], list[RunSummary]]] = []
    for run in runs:
        own = comparable_settings(run.config)
        own.pop(SEED)
        members = next((members for known, members in alike if known == own), None)
        if members is None:
            alike.append((own, members := []))
        members.append(run)
    settings, places, found = [], [], []
    for own, members in alike:
        for place, part in _part_by_folder(members):
            settings.append(own)
            places.append(place)
            found.append(part)
    names = list(dict.fromkeys(name for own in settings for name in own))
    differ = {name: [own.get(name) for own in settings] for name in names}
    differ = {name: values for name, values in differ.items() if any(value != values[0] for value in values)}
    groups = []
    chosen = _choose_settings(differ)
    for index, members in enumerate(found):
        words = [f"{name.partition('.')[2]} {differ[name][index]}" for name in chosen]
        name = ", ".join(words) + (f" and {len(differ) - len(words)} more" if len(differ) > len(words) else "")
        ordered = sorted(members, key=lambda run: run.config.run.seed)
        groups.append(Group((name or members[0].task) + places[index], members[0].task, ordered))
    return groups, differ


def _part_by_folder(runs: list[RunSummary]) -> list[tuple[str, list[RunSummary]]]:
    """Runs with the same settings, together where no seed repeats, otherwise by the folder that holds them."""
    if len({run.config.run.seed for run in runs}) == len(runs):
        return [("", runs)]
    parts: dict[Path, dict[int, RunSummary]] = {}
    for run in runs:
        part = parts.setdefault(run.folder.parent, {})
        first = part.setdefault(run.config.run.seed, run)
        if first is not run:
            raise UserError(
                f"{first.folder} and {run.folder} have the same settings and the same seed: give one of them"
            )
    return [(f" in {folder}", list(part.values())) for folder, part in parts.items()]


def _choose_settings(differ: dict[str, list[Any]]) -> list[str]:
    """The settings that name groups: those that tell all groups apart, and as many others as make two."""
    chosen: list[str] = []
    parts = 1
    for name in differ:
        num = len({*zip(*(map(str, differ[each]) for each in (*chosen, name)), strict=True)})
        if num > parts:
            chosen, parts = [*chosen, name], num
    others = [name for name in differ if name not in chosen]
    shown = {*chosen, *others[: max(0, 2 - len(chosen))]}
    return [name for name in differ if name in shown]


def mean_curve(group: Group, mode: str, clock: str, interval: Interval) -> Line | None:
    """Mean return of a group over its seeds, with its interval, where every seed has been evaluated.

    Returns are interpolated between the evaluations of a seed.

    Args:
        group: The runs.
        mode: `planner` or `actor`.
        clock: `env_frames`, `updates` or `minutes`.
        interval: Ends of the interval of the mean of a few returns; NaN for one return.

    Returns:
        The line; None before the seeds have evaluations in common.
    """
    runs = [run.evaluations for run in group.runs if run.evaluations]
    if not runs:
        return None
    times = [np.array([getattr(each, clock) for each in evaluations], float) for evaluations in runs]
    first, last = max(time[0] for time in times), min(time[-1] for time in times)
    if first > last:
        return None
    grid = times[0] if len(runs) == 1 else np.linspace(first, last, NUM_POINTS if last > first else 1)
    values = np.array(
        [
            np.interp(grid, time, [getattr(each, mode) for each in evaluations])
            for time, evaluations in zip(times, runs, strict=True)
        ]
    )
    ends = np.array([interval(column.tolist()) for column in values.T])
    seeds = f"{len(runs)} seed{'' if len(runs) == 1 else 's'}"
    has_ends = len(runs) > 1
    return Line(
        f"{group.name}, {seeds}",
        grid,
        values.mean(axis=0),
        ends[:, 0] if has_ends else None,
        ends[:, 1] if has_ends else None,
    )


def summary_rows(groups: Sequence[Group], interval: Interval) -> list[list[str]]:
    """A row for each group: seeds, frames, and the mean of the latest returns with its interval."""
    rows = [["runs", "task", "seeds", "frames", "minutes", "planner (95 %)", "actor (95 %)"]]
    for group in groups:
        seeds = ", ".join(str(run.config.run.seed) for run in group.runs)
        frames = _span([run.env_frames for run in group.runs], "{:,}")
        minutes = _span([run.minutes for run in group.runs], "{:.1f}")
        returns = [
            _mean([getattr(run.evaluations[-1], mode) for run in group.runs if run.evaluations], interval)
            for mode in MODES
        ]
        rows.append([group.name, group.task, seeds, frames, minutes, *returns])
    return rows


def setting_rows(groups: Sequence[Group], differ: dict[str, list[Any]]) -> list[list[str]]:
    """A row for each setting that differs between groups, below a header; the header alone where none differs."""
    rows = [["setting", *(group.name for group in groups)]]
    return rows + [[name, *map(str, values)] for name, values in differ.items()]


def render_comparison(runs: Sequence[RunSummary], interval: Interval) -> str:
    """The page that compares runs, as HTML."""
    groups, differ = group_runs(runs)
    settings = setting_rows(groups, differ)
    films = [(run, latest_film(run.folder)) for run in runs]
    largest = LARGEST_FILM // max(1, sum(path is not None for _, path in films))
    shown = [
        figure(film(path, f"film of {run.folder.name}", largest), f"{run.folder.name}: {run.task}, {path.name}")
        for run, path in films
        if path is not None
    ]
    return render_page(
        "Comparison of training runs",
        [
            Section(
                "Returns",
                "Mean returns of the latest evaluation, with Student's 95 % interval of the mean over seeds.",
                [table(summary_rows(groups, interval))],
            ),
            Section(
                "Learning curves",
                "Mean return of the evaluations over seeds. Bands and bars are Student's 95 % intervals; one seed has "
                "no interval.",
                _curves(groups, interval),
            ),
            Section(
                "Settings that differ",
                "Settings that are not listed are the same in all runs; seeds and budgets are not compared.",
                [table(settings)] if len(settings) > 1 else ["<p>All settings are the same.</p>"],
            ),
            Section("Films", "The latest film of each run: camera on the left, the end of the plan right.", shown),
            Section("Runs", "Every run with its state.", [table(_run_rows(runs))]),
        ],
    )


def latest_film(folder: Path) -> Path | None:
    """The film of the latest evaluation of a run; None without a film."""
    films = sorted(path for path in (folder / "videos").glob("*.webm") if not path.name.startswith("."))
    final = folder / "videos" / "final.webm"
    others = [path for path in films if path != final]
    is_latest = final in films and (has_final_evaluation(folder) or not others)
    return final if is_latest else others[-1] if others else None


def _curves(groups: Sequence[Group], interval: Interval) -> list[str]:
    """For each task and mode, the curves in frames and in minutes."""
    figures = []
    for task in dict.fromkeys(group.task for group in groups):
        own = [group for group in groups if group.task == task]
        has_frames = any(run.env_frames for group in own for run in group.runs)
        for mode in MODES:
            for clock, unit in (CLOCKS if has_frames else OFFLINE_CLOCKS).items():
                lines = [mean_curve(group, mode, clock, interval) for group in own]
                drawn = [line for line in lines if line is not None]
                if drawn:
                    labels = Labels(f"{task}: return of the {mode} against {unit}", unit, f"return of the {mode}")
                    figures.append(figure(plot_lines(drawn, labels, large_x=clock != "minutes"), labels.alt))
        if known := published_returns_of(task):
            figures.append(table(published_rows(known), f"{task}: published mean returns"))
    return figures


def published_rows(known: Any) -> list[list[str]]:
    """Published returns of a task by method and number of frames, below a header."""
    columns = sorted({frames for means in known.values() for frames in means})
    rows = [["published method", *(f"{frames // 1000:,}k" for frames in columns)]]
    return rows + [[name, *(format_return(means.get(at)) for at in columns)] for name, means in known.items()]


def _run_rows(runs: Sequence[RunSummary]) -> list[list[str]]:
    rows = [["run", "seed", "frames", "minutes", "best", "last", "state"]]
    for run in runs:
        clocks = f"{run.env_frames:,}", f"{run.minutes:.1f}"
        returns = format_return(run.best), format_return(run.last)
        rows.append([str(run.folder), str(run.config.run.seed), *clocks, *returns, run.state])
    return rows


def _span(values: Sequence[float], form: str) -> str:
    low, high = form.format(min(values)), form.format(max(values))
    return low if low == high else f"{low} to {high}"


def _mean(values: Sequence[float], interval: Interval) -> str:
    if not values:
        return "-"
    low, high = interval(values)
    mean = float(np.mean(np.asarray(values, float)))
    return f"{mean:.1f}" if math.isnan(low) else f"{mean:.1f} ({low:.1f} to {high:.1f})"
