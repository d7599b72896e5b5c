"""`benchmark.py learn --tasks T,T --seeds S,S`: learning curves over tasks and seeds, beside published returns.

Every run is a `train.py` process. The tables show env frames and minutes until a run reaches an evaluation return, and
final returns as interquartile means with 95 % intervals; `curves.csv`, `summary.json` and `curves.png` hold the same.
"""

from __future__ import annotations

import math
import signal
import statistics
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from bench.learn_plot import Curve, Point, plot_runs
from bench.report import format_interval, format_number, format_table, write_csv, write_json
from bench.run_evaluations import keep_final, read_all_evaluations
from bench.runs import RunsRequest, TrainingRun
from latentplan.config import UserError, make_folder
from latentplan.config.env_id import as_file_name
from latentplan.config.parsing import option
from latentplan.config.suites import SUITES, check_task
from latentplan.reporting.published import FRAMES, published_returns_of

FRAMES_TOLERANCE = 0.03  # largest distance of an evaluation from a number of frames, as a share of that number
OWN = "latentplan"


@dataclass(frozen=True, kw_only=True)
class Request(RunsRequest):
    """Flags of `benchmark.py learn`.

    Attributes:
        tasks: Tasks, each as domain-task, or as gymnasium-ID for an environment of gymnasium's registry. A domain alone
            stands for its usual task.
        thresholds: Evaluation returns; the frames and minutes until each of these returns are reported.
        mode: Agent whose evaluation returns are reported.
    """

    thresholds: tuple[int, ...] = option((250, 500, 750), separator=",")
    mode: Literal["planner", "actor"] = "planner"

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "tasks", tuple(dict.fromkeys(map(name_task, self.tasks))))
        if min(self.thresholds) < 0:
            raise UserError(f"--thresholds must be at least 0, got {min(self.thresholds)}")


def run(request: Request) -> int:
    """Trains the unfinished runs, then collects, tabulates and plots the curves of all runs."""
    tasks, thresholds, mode, out = request.tasks, request.thresholds, request.mode, request.out
    runs = [
        TrainingRun(task, seed, out / as_file_name(f"{task}-seed{seed}"), request.budget, request.forwarded)
        for task in tasks
        for seed in request.seeds
    ]
    for each in runs:  # refuses a mistake in any run before the first run begins
        each.check()
    make_folder(out)
    for each in runs:
        _train(each)
    curves = [read_run(each.task, each.seed, each.folder, mode, request.frames) for each in runs]
    write_csv(out / "curves.csv", [{"task": c.task, "seed": c.seed, **p._asdict()} for c in curves for p in c.points])
    print(run_table(curves, thresholds))
    finals = final_estimates(curves)
    print(format_table(["task", "runs", "interquartile mean", "95 %"], [_final_row(*item) for item in finals.items()]))
    comparisons = {task: compare(task, curves, thresholds) for task in dict.fromkeys(tasks)}
    for task, rows in comparisons.items():
        print(comparison_table(task, rows, thresholds))
    facts = run_facts(curves, thresholds)
    write_json(out / "summary.json", {"mode": mode, "runs": facts, "final": finals, "anchors": comparisons})
    plot_runs(curves, mode, out / "curves.png")
    print(f"curves.csv, summary.json and curves.png are in {out}")
    return 0


def name_task(name: str) -> str:
    """The name of a task as domain-task, where a domain alone stands for its usual task; other names are unchanged."""
    suite = next((suite for suite, each in SUITES.items() if name in each.tasks), None)
    return name if suite is None else f"{name}-{check_task(suite, name)[0]}"


def read_run(task: str, seed: int, folder: Path, mode: str, frames: int | None = None) -> Curve:
    """The evaluations of a run, including the final evaluation and those of shorter budgets.

    Args:
        task: The task.
        seed: The seed.
        folder: Folder of the run.
        mode: Agent whose returns are taken.
        frames: Budget of env frames, after which a longer run's evaluations do not count; None takes all.

    Raises:
        UserError: The run has no evaluation within its budget, one is not finite, or its files are damaged.
    """
    points = [Point(each.env_frames, each.minutes, getattr(each, mode)) for each in read_all_evaluations(folder)]
    if not points:
        raise UserError(f"{folder} holds no evaluation; lower --evaluation.every_frames or train longer")
    if frames is not None:
        points = [point for point in points if point.env_frames <= (1.0 + FRAMES_TOLERANCE) * frames]
        if not points:
            raise UserError(
                f"{folder} holds no evaluation within {frames:,} frames; give more --frames or another --out"
            )
    for point in points:
        if not all(map(math.isfinite, point)):
            raise UserError(f"{folder} has an evaluation that is not finite, at {point.env_frames:,} frames")
    return Curve(task, seed, points)


def first_reaching(curve: Curve, threshold: float) -> Point | None:
    """The first evaluation with a return of at least `threshold`, or None."""
    return next((point for point in curve.points if point.total_return >= threshold), None)


def run_facts(curves: Sequence[Curve], thresholds: Sequence[int]) -> list[dict[str, Any]]:
    """Env frames, minutes and final return of each run, and frames and minutes to each threshold (None if missed)."""
    facts = []
    for curve in curves:
        reached = {str(threshold): first_reaching(curve, threshold) for threshold in thresholds}
        last = curve.points[-1]
        facts.append(
            {
                "task": curve.task,
                "seed": curve.seed,
                "env_frames": last.env_frames,
                "minutes": last.minutes,
                "final_return": last.total_return,
                "frames_to": {name: point and point.env_frames for name, point in reached.items()},
                "minutes_to": {name: point and point.minutes for name, point in reached.items()},
            }
        )
    return facts


def run_table(curves: Sequence[Curve], thresholds: Sequence[int]) -> str:
    """`run_facts` as a text table; frames and minutes to a threshold share a cell."""
    rows = []
    for facts in run_facts(curves, thresholds):
        cells = [
            f"{facts['task']} seed {facts['seed']}",
            format_number(facts["env_frames"], 0),
            format_number(facts["minutes"]),
        ]
        for threshold in map(str, thresholds):
            frames, minutes = facts["frames_to"][threshold], facts["minutes_to"][threshold]
            cells.append("-" if frames is None else f"{frames:,.0f} / {minutes:.1f}")
        rows.append([*cells, format_number(facts["final_return"])])
    header = ["run", "frames", "minutes", *(f"frames / min to {threshold}" for threshold in thresholds), "final"]
    return format_table(header, rows)


def final_estimates(curves: Sequence[Curve]) -> dict[str, dict[str, Any]]:
    """Interquartile mean of the final returns with its interval, by task and, for several tasks, over all."""
    from bench.estimates import interquartile_estimate

    groups: dict[str, list[float]] = {}
    for curve in curves:
        groups.setdefault(curve.task, []).append(curve.points[-1].total_return)
    wanted = {task: [group] for task, group in groups.items()}
    if len(groups) > 1:
        wanted["all tasks"] = list(groups.values())
    return {
        name: {"runs": sum(map(len, chosen)), **interquartile_estimate(chosen)._asdict()}
        for name, chosen in wanted.items()
    }


def compare(task: str, curves: Sequence[Curve], thresholds: Sequence[int]) -> dict[str, dict[str, Any]]:
    """Results of this project's runs of a task, followed by published results, by method.

    Returns:
        For each method `returns` by env frames (for own runs the interquartile mean over the evaluations near that
        number of frames, with `intervals`), and `frames_to` each threshold. For published methods `frames_to` is the
        first number of frames with a known return of at least the threshold; for own runs the median over runs, None
        if half of the runs do not reach the threshold.
    """
    from bench.estimates import interquartile_estimate

    own = [curve for curve in curves if curve.task == task]
    returns, intervals = {}, {}
    for frames in FRAMES:
        near = [point.total_return for curve in own if (point := _nearest_point(curve, frames)) is not None]
        if near:
            returns[frames], *intervals[frames] = interquartile_estimate([near])
    rows: dict[str, dict[str, Any]] = {OWN: {"returns": returns, "intervals": intervals}}
    rows[OWN]["frames_to"] = {str(threshold): _median_frames(own, threshold) for threshold in thresholds}
    for method, known in published_returns_of(task).items():
        reached = {
            str(threshold): next((frames for frames in sorted(known) if known[frames] >= threshold), None)
            for threshold in thresholds
        }
        rows[method] = {"returns": dict(known), "frames_to": reached}
    return rows


def comparison_table(task: str, rows: Mapping[str, Mapping[str, Any]], thresholds: Sequence[int]) -> str:
    """The result of `compare` as a text table."""
    table = []
    for method, facts in rows.items():
        cells = [format_number(facts["returns"].get(frames), 0) for frames in FRAMES]
        reached = [format_number(facts["frames_to"][str(threshold)], 0) for threshold in thresholds]
        table.append([method, *cells, *reached])
    columns = [*(f"at {frames:,}" for frames in FRAMES), *(f"frames to {threshold}" for threshold in thresholds)]
    return format_table([task, *columns], table)


def _nearest_point(curve: Curve, frames: int) -> Point | None:
    """The evaluation nearest to a number of env frames; None if its distance exceeds `FRAMES_TOLERANCE`."""
    point = min(curve.points, key=lambda point: abs(point.env_frames - frames))
    return point if abs(point.env_frames - frames) <= FRAMES_TOLERANCE * frames else None


def _median_frames(curves: Sequence[Curve], threshold: int) -> float | None:
    reached = [point.env_frames if (point := first_reaching(curve, threshold)) else math.inf for curve in curves]
    middle = statistics.median(reached)
    return None if math.isinf(middle) else middle


def _train(run: TrainingRun) -> None:
    """Runs `train.py` in a new process, unless the run is finished."""
    if run.is_finished():
        print(f"{run.folder} is finished and not repeated", flush=True)
        return
    print(f"training {run.name}", flush=True)
    keep_final(run.folder)
    training = subprocess.Popen(run.command())
    previous = signal.signal(signal.SIGINT, signal.SIG_IGN)  # the run gets Ctrl-C too, and saves its state
    try:
        code = training.wait()
    except BaseException:  # such as the exit that a SIGTERM causes
        training.terminate()  # the run saves its state
        training.wait()
        raise
    finally:
        signal.signal(signal.SIGINT, previous)
    if code == 130:
        raise KeyboardInterrupt
    if code != 0:
        raise UserError(f"training {run.name} ended with exit code {code}; see above")
    run.mark_finished()


def _final_row(name: str, facts: dict[str, Any]) -> list[str]:
    return [name, str(facts["runs"]), format_number(facts["mean"]), format_interval((facts["low"], facts["high"]))]
