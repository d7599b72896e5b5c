"""`benchmark.py learn --tasks T,T --seeds S,S`: learning curves over tasks and seeds, beside published returns.

Every run is a `train.py` process. The tables show env frames and minutes until a run reaches an evaluation return, and
final returns as interquartile means with 95 % intervals; `curves.csv`, `summary.json` and `curves.png` hold the same.
"""

from __future__ import annotations

import json
import math
import signal
import statistics
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from bench.anchors import FRAMES, published_returns_of
from bench.learn_plot import Curve, Point, plot_runs
from bench.report import format_interval, format_number, format_table, write_csv, write_json
from latentplan.commands import train
from latentplan.commands.flags import overrides, read_request
from latentplan.config import Config, Device, RunConfig, UserError, make_folder, to_dict
from latentplan.config.checks import above_zero
from latentplan.config.env_id import FLAG, as_file_name
from latentplan.config.files import Preset, read_config
from latentplan.config.parsing import option
from latentplan.config.suites import ID_DOMAIN

OWN_FLAGS = {  # settings that flags of this benchmark set for each run
    "env.domain": "--tasks",
    "env.task": "--tasks",
    "run.seed": "--seeds",
    "run.frames": "--frames",
    "run.minutes": "--minutes",
    "run.run_dir": "--out",
}
FINISHED = "finished.json"
FRAMES_TOLERANCE = 0.03  # largest distance of an evaluation from a number of frames, as a share of that number
OWN = "latentplan"


@dataclass(frozen=True, kw_only=True)
class Request:
    """Flags of `benchmark.py learn`.

    Attributes:
        tasks: Tasks, each as domain-task, or as gymnasium-ID for an environment of gymnasium's registry.
        seeds: Seeds of each task.
        frames: Simulator frames of each run; without frames and minutes, a run has the budget of the preset.
        minutes: Minutes of each run; with frames given too, a run ends at the first of the two limits.
        thresholds: Evaluation returns; the frames and minutes until each of these returns are reported.
        mode: Agent whose evaluation returns are reported.
        out: Folder of the runs and results; finished runs in this folder are not repeated.
        preset: Machine class, as for training; None takes `gpu` where CUDA is usable, else `cpu`.
        device: Device, as for training; None takes CUDA where it is usable.
        config: YAML file of settings, as for training.
        settings: Settings of every run, by section and name.
    """

    tasks: tuple[str, ...] = option(("cartpole-swingup", "walker-walk"), separator=",")
    seeds: tuple[int, ...] = option((0, 1), separator=",")
    frames: int | None = None
    minutes: float | None = None
    thresholds: tuple[int, ...] = option((250, 500, 750), separator=",")
    mode: Literal["planner", "actor"] = "planner"
    out: Path = option(Path("runs/learn"), metavar="DIR")
    preset: Preset | None = None
    device: Device | None = None
    config: Path | None = option(None, metavar="FILE")
    settings: dict[str, Any] = overrides(Config)

    def __post_init__(self) -> None:
        above_zero(self, "frames", "minutes")
        for name in ("seeds", "thresholds"):
            if min(getattr(self, name)) < 0:
                raise UserError(f"--{name} must be at least 0, got {min(getattr(self, name))}")
        for key, own in OWN_FLAGS.items():
            section, _, name = key.partition(".")
            if name in self.settings.get(section, {}):
                raise UserError(f"{own} sets --{key} here; give {own}")

    @property
    def budget(self) -> list[str]:
        """The flags of `train.py` that end a run."""
        given = (("--frames", self.frames), ("--minutes", self.minutes))
        return [word for name, value in given if value is not None for word in (name, f"{value:.15g}")]

    @property
    def forwarded(self) -> list[str]:
        """The other flags of `train.py` that all runs share."""
        flags: dict[str, Any] = {"--preset": self.preset, "--device": self.device, "--config": self.config}
        words = [word for name, value in flags.items() if value is not None for word in (name, str(value))]
        for section, fields in self.settings.items():
            for name, value in fields.items():
                words += [f"--{section}.{name}", value if isinstance(value, str) else json.dumps(value)]
        return words


def run(request: Request) -> int:
    """Trains the unfinished runs, then collects, tabulates and plots the curves of all runs."""
    tasks, thresholds, mode, out = request.tasks, request.thresholds, request.mode, request.out
    budget, extra = request.budget, request.forwarded
    folders = {(task, seed): out / as_file_name(f"{task}-seed{seed}") for task in tasks for seed in request.seeds}
    for (task, seed), folder in folders.items():  # refuses a mistake in any run before the first run begins
        asked = read_request(train.Request, _new_run_flags(task, seed, folder, budget, extra))
        check_same(train.resolve(asked), folder)
    make_folder(out)
    for (task, seed), folder in folders.items():
        _train(task, seed, folder, budget, extra)
    curves = [read_run(task, seed, folder, mode) for (task, seed), folder in folders.items()]
    write_csv(out / "curves.csv", [{"task": c.task, "seed": c.seed, **p._asdict()} for c in curves for p in c.points])
    print(run_table(curves, thresholds))
    finals = final_estimates(curves)
    print(format_table(["task", "runs", "interquartile mean", "95 %"], [_final_row(*item) for item in finals.items()]))
    comparisons = {task: compare(task, curves, thresholds) for task in dict.fromkeys(tasks)}
    for task, rows in comparisons.items():
        print(comparison_table(task, rows, thresholds))
    runs = run_facts(curves, thresholds)
    write_json(out / "summary.json", {"mode": mode, "runs": runs, "final": finals, "anchors": comparisons})
    plot_runs(curves, mode, out / "curves.png")
    print(f"curves.csv, summary.json and curves.png are in {out}")
    return 0


def read_run(task: str, seed: int, folder: Path, mode: str) -> Curve:
    """The evaluations of a run, including the final evaluation.

    Raises:
        UserError: The run has no evaluation, or its files are damaged.
    """
    from latentplan.reporting.curves import read_curve

    column = f"{mode}_return"
    try:
        frames, returns = read_curve(folder / "metrics.csv", "env_frames", column)
        minutes, _ = read_curve(folder / "metrics.csv", "minutes", column)
        points = [Point(*point) for point in zip(frames, minutes, returns, strict=True)]
        if (folder / "final.json").exists():
            final = json.loads((folder / "final.json").read_text())
            points = [point for point in points if point.env_frames < final["env_frames"]]
            points.append(Point(final["env_frames"], final["minutes"], final[mode]))
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise UserError(f"the results in {folder} cannot be read: {error}") from None
    if not points:
        raise UserError(f"{folder} holds no evaluation; lower --evaluation.every_frames or train longer")
    return Curve(task, seed, points)


def check_same(config: Config, folder: Path) -> None:
    """Checks that the run in a folder, if there is one, has these settings, except for the budget.

    Raises:
        UserError: A setting differs; the message names the first such setting.
    """
    if not (folder / "config.yaml").exists():
        return
    asked, begun = (_comparable_settings(each) for each in (config, read_config(folder / "config.yaml")))
    for name, value in asked.items():
        if begun[name] != value:
            raise UserError(f"{folder} was begun with --{name} {begun[name]}, not {value}: choose another --out")


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


def _comparable_settings(config: Config) -> dict[str, Any]:
    """The settings by name, with the default task filled in and without the budget and folder of the run."""
    from latentplan.envs import default_task

    env = replace(config.env, task=config.env.task or default_task(config.env.domain))
    sections = to_dict(replace(config, env=env, run=RunConfig(seed=config.run.seed)))
    return {f"{section}.{name}": value for section, fields in sections.items() for name, value in fields.items()}


def _nearest_point(curve: Curve, frames: int) -> Point | None:
    """The evaluation nearest to a number of env frames; None if its distance exceeds `FRAMES_TOLERANCE`."""
    point = min(curve.points, key=lambda point: abs(point.env_frames - frames))
    return point if abs(point.env_frames - frames) <= FRAMES_TOLERANCE * frames else None


def _median_frames(curves: Sequence[Curve], threshold: int) -> float | None:
    reached = [point.env_frames if (point := first_reaching(curve, threshold)) else math.inf for curve in curves]
    middle = statistics.median(reached)
    return None if math.isinf(middle) else middle


def _train(task: str, seed: int, folder: Path, budget: list[str], extra: list[str]) -> None:
    """Runs `train.py` in a new process, unless the folder holds the finished run with this budget."""
    marker = folder / FINISHED
    if _read_budget(marker) == budget:
        print(f"{folder} is finished and not repeated", flush=True)
        return
    is_begun = (folder / "config.yaml").exists()
    arguments = _new_run_flags(task, seed, folder, budget, extra)
    if is_begun:
        arguments = ["--resume", str(folder), *budget, *(arguments[:2] if arguments[0] == FLAG else [])]
    script = Path(__file__).resolve().parent.parent / "train.py"
    print(f"training {task}, seed {seed}", flush=True)
    training = subprocess.Popen([sys.executable, str(script), *arguments])
    previous = signal.signal(signal.SIGINT, signal.SIG_IGN)  # the run gets Ctrl-C too, and saves its state
    try:
        code = training.wait()
    finally:
        signal.signal(signal.SIGINT, previous)
    if code == 130:
        raise KeyboardInterrupt
    if code != 0:
        raise UserError(f"training {task} with seed {seed} ended with exit code {code}; see above")
    write_json(marker, {"budget": budget})


def _read_budget(marker: Path) -> list[str] | None:
    """The budget of a finished run; None if the run is not finished or its marker cannot be read."""
    try:
        budget: list[str] = json.loads(marker.read_text())["budget"]
    except (OSError, ValueError, TypeError, KeyError):
        return None
    return budget


def _new_run_flags(task: str, seed: int, folder: Path, budget: list[str], extra: list[str]) -> list[str]:
    domain, _, name = task.partition("-")
    chosen = [FLAG, name] if domain == ID_DOMAIN else ["--domain", domain, *(["--task", name] if name else [])]
    return [*chosen, "--seed", str(seed), "--run-dir", str(folder), *budget, *extra]


def _final_row(name: str, facts: dict[str, Any]) -> list[str]:
    return [name, str(facts["runs"]), format_number(facts["mean"]), format_interval((facts["low"], facts["high"]))]
