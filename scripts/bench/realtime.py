"""`benchmark.py realtime --checkpoint DIR`: return and decision time, with and without an environment that waits.

Four parts: returns by the iterations of a search, by the control rate (Hz) of an environment that does not wait, by the
number of actions executed from each plan, and the model's prediction error by model steps. Times are in milliseconds.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.options import DEVICE_FLAGS, Flags, choose_device, output_path, positive_number, whole_number, words
from bench.report import format_table, interval, number, write_json
from latentplan.config import UserError, to_dict
from latentplan.config.files import raise_unknown

if TYPE_CHECKING:
    from bench.realtime_measurements import Row, Trial

PARTS = ("iterations", "rates", "error", "replan")
FLAGS = {
    "--checkpoint": ("DIR", "trained agent, or run (its best checkpoint)"),
    "--episodes": ("N", "episodes of each point, on the same starts (5)"),
    "--seed": ("S", "episode i starts from a state that depends only on S and i (0)"),
    "--parts": ("P,P", f"any of {','.join(PARTS)} (all)"),
    "--rates": ("F,F", "decisions per second of the worlds that do not wait (25,50,100,200)"),
    **DEVICE_FLAGS,
    "--json": ("FILE", "result as JSON, written anew after every point"),
    "--plot": ("PNG", "result as a picture"),
}
SETTINGS = ()


def run(flags: Flags) -> int:
    """Measure the parts that were asked for, one point after the other."""
    if "--checkpoint" not in flags:
        raise UserError("flag --checkpoint is missing; give the folder of a trained agent or of a run")
    episodes, seed = whole_number(flags, "--episodes", 5), whole_number(flags, "--seed", 0, least=0)
    parts = words(flags, "--parts", ",".join(PARTS))
    for part in parts:
        if part not in PARTS:
            raise_unknown("part", part, PARTS)
    rates = [positive_number({"--rates": word}, "--rates", 0.0) for word in words(flags, "--rates", "25,50,100,200")]
    json_path, plot_path = output_path(flags, "--json"), output_path(flags, "--plot")
    device = choose_device(flags)
    from bench.ablation_arms import check_checkpoint
    from bench.machine import describe_machine
    from bench.realtime_measurements import Trial
    from latentplan.agents.checkpoint import load_model
    from latentplan.envs import make_env
    from latentplan.evaluation.episodes import episode_seed

    info, planner = check_checkpoint(Path(flags["--checkpoint"]))
    about = {
        "checkpoint": flags["--checkpoint"],
        "domain": info["domain"],
        "task": info["task"],
        "episodes": episodes,
        "seed": seed,
        "planner": to_dict(planner),
        "machine": describe_machine(device),
    }
    print(f"{about['domain']}-{about['task']}, {episodes} episodes per point", flush=True)
    env = make_env(load_model(flags["--checkpoint"])[1].env)
    seeds = [episode_seed(seed, index) for index in range(episodes)]
    result: dict[str, list[Row]] = {part: [] for part in parts}
    try:
        trial = Trial(flags["--checkpoint"], str(device), env, seeds, planner.horizon)
        for part, row in measure_parts(trial, parts, rates):
            result[part].append(row)
            print(_progress(part, row), flush=True)
            write_json(json_path, {**about, **result})
    finally:
        env.close()
    for part, rows in result.items():
        print(f"\n{part_table(part, rows)}")
    if plot_path is not None:
        from bench.realtime_plot import plot_realtime

        plot_realtime(result, plot_path)
    return 0


def measure_parts(trial: Trial, parts: Sequence[str], rates: Sequence[float]) -> Iterator[tuple[str, Row]]:
    """Yields each row of each part, as soon as it is measured."""
    from bench.realtime_measurements import measure_error, measure_iterations, measure_rates, measure_replanning

    rows = {
        "iterations": lambda: measure_iterations(trial),
        "rates": lambda: measure_rates(trial, rates),
        "error": lambda: measure_error(trial),
        "replan": lambda: measure_replanning(trial),
    }
    for part in parts:
        for row in rows[part]():
            yield part, row


def part_table(part: str, rows: Sequence[Row]) -> str:
    """A part as a text table."""
    columns = {
        "iterations": ("iterations", *_RETURN, *_LATENCY),
        "rates": ("agent", "Hz", *_RETURN, *_LATENCY, "missed", "planned"),
        "error": ("step", "latent distance", "of no change", "reward error", "of no change"),
        "replan": ("replan every", "horizon", *_RETURN, "ms mean"),
    }
    return format_table(columns[part], [_cells(part, row) for row in rows])


_RETURN = ("return", "95 %")
_LATENCY = ("ms p50", "p95")


def _cells(part: str, row: Mapping[str, Any]) -> list[str]:
    if part == "error":
        names = ("latent_distance", "latent_change", "reward_error", "reward_change")
        return [str(row["step"]), *(number(row[name], 3) for name in names)]
    earned = [number(row["mean_return"]), interval(row["ci95"])]
    latency = [number(row["decision_ms"][name], 2) for name in ("p50", "p95")]
    if part == "iterations":
        return [row["iterations"], *earned, *latency]
    if part == "replan":
        return [str(row["replan_every"]), str(row["horizon"]), *earned, number(row["mean_decision_ms"], 2)]
    planned = f"{100.0 * row['planned_fraction']:.0f} %"
    return [row["agent"], f"{row['control_hz']:g}", *earned, *latency, str(row["deadline_misses"]), planned]


def _progress(part: str, row: Mapping[str, Any]) -> str:
    if part == "error":
        return f"error, step {row['step']}: latent distance {row['latent_distance']:.3f}"
    point = {
        "iterations": lambda: row["iterations"],
        "rates": lambda: f"{row['agent']} at {row['control_hz']:g} Hz",
        "replan": lambda: f"every {row['replan_every']}",
    }[part]()
    return f"{part}, {point}: mean return {row['mean_return']:.1f}"
