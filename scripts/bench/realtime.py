"""`benchmark.py realtime --checkpoint DIR`: return and decision time, with and without an environment that waits.

Four parts: returns by the iterations of a search, by the control rate (Hz) of an environment that does not wait, by the
number of actions executed from each plan, and the model's prediction error by model steps. Times are in milliseconds.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.report import format_interval, format_number, format_table, write_json
from latentplan.commands.shell import ComputeRequest
from latentplan.config import UserError, to_dict
from latentplan.config.checks import at_least
from latentplan.config.parsing import option, require_known

if TYPE_CHECKING:
    from bench.realtime_measurements import Row, Trial

PARTS = ("iterations", "rates", "error", "replan")
_RETURN = ("return", "95 %")
_LATENCY = ("ms p50", "p95")


@dataclass(frozen=True, kw_only=True)
class Request(ComputeRequest):
    """Flags of `benchmark.py realtime`.

    Attributes:
        checkpoint: Folder of a trained agent, or of a run (its best checkpoint).
        episodes: Episodes of each point, from the same starts.
        seed: Seed of the starts: episode i starts from a state that depends only on the seed and i.
        parts: Parts of the measurement, each once.
        rates: Decisions per second of environments that do not wait, each once.
        json: Result as JSON, written anew after every point.
        plot: Result as a picture.
    """

    checkpoint: Path = option(metavar="DIR")
    episodes: int = 5
    seed: int = 0
    parts: tuple[str, ...] = option(PARTS, separator=",")
    rates: tuple[float, ...] = option((25.0, 50.0, 100.0, 200.0), separator=",")
    json: Path | None = option(None, metavar="FILE", is_output=True)
    plot: Path | None = option(None, metavar="PNG", is_output=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, episodes=1, seed=0)
        require_known("part", self.parts, PARTS)
        object.__setattr__(self, "parts", tuple(dict.fromkeys(self.parts)))
        object.__setattr__(self, "rates", tuple(dict.fromkeys(self.rates)))
        if min(self.rates) <= 0.0:
            raise UserError(f"--rates must be above 0, got {min(self.rates):g}")


def run(request: Request) -> int:
    """Measures the parts of the request, one point after the other."""
    episodes, seed, checkpoint = request.episodes, request.seed, str(request.checkpoint)
    device = request.use_device()
    import torch

    from bench.machine import describe_machine
    from bench.realtime_measurements import Trial
    from latentplan.agents.checkpoint import load_model
    from latentplan.agents.info import require_unchanged
    from latentplan.envs import make_env
    from latentplan.evaluation.episodes import episode_seed

    _, config, info = load_model(request.checkpoint)
    planner = config.planner
    about = {
        "checkpoint": checkpoint,
        "domain": info["domain"],
        "task": info["task"],
        "episodes": episodes,
        "seed": seed,
        "planner": to_dict(planner),
        "machine": describe_machine(torch.device(device)),
    }
    print(f"{about['domain']}-{about['task']}, {episodes} episodes per point", flush=True)
    env = make_env(config.env)
    seeds = [episode_seed(seed, index) for index in range(episodes)]
    result: dict[str, list[Row]] = {part: [] for part in request.parts}
    try:
        check_parts(request.parts, env)
        trial = Trial(checkpoint, device, env, seeds, planner.horizon)
        for part, row in measure_parts(trial, request.parts, request.rates):
            require_unchanged(checkpoint, info)
            result[part].append(row)
            print(_progress_line(part, row), flush=True)
            write_json(request.json, {**about, **result})
    finally:
        env.close()
    for part, rows in result.items():
        print(f"\n{part_table(part, rows)}")
    if request.plot is not None:
        from bench.realtime_plot import plot_realtime

        plot_realtime(result, request.plot)
    return 0


def check_parts(parts: Sequence[str], env: Any) -> None:
    """Checks that an environment can be played in these parts.

    Raises:
        UserError: Its action cannot change within a decision, as it must where the environment does not wait.
    """
    if "rates" in parts and not hasattr(env, "step_schedule"):
        others = ",".join(part for part in PARTS if part != "rates")
        raise UserError(f"the action of this environment cannot change within a decision: give --parts {others}")


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
    return format_table(columns[part], [_row_cells(part, row) for row in rows])


def _row_cells(part: str, row: Mapping[str, Any]) -> list[str]:
    if part == "error":
        names = ("latent_distance", "latent_change", "reward_error", "reward_change")
        return [str(row["step"]), *(format_number(row[name], 3) for name in names)]
    earned = [format_number(row["mean_return"]), format_interval(row["ci95"])]
    latency = [format_number(row["decision_ms"][name], 2) for name in ("p50", "p95")]
    if part == "iterations":
        return [row["iterations"], *earned, *latency]
    if part == "replan":
        return [str(row["replan_every"]), str(row["horizon"]), *earned, format_number(row["mean_decision_ms"], 2)]
    planned = f"{100.0 * row['planned_fraction']:.0f} %"
    return [row["agent"], f"{row['control_hz']:g}", *earned, *latency, str(row["deadline_misses"]), planned]


def _progress_line(part: str, row: Mapping[str, Any]) -> str:
    if part == "error":
        return f"error, step {row['step']}: latent distance {row['latent_distance']:.3f}"
    point = {
        "iterations": lambda: row["iterations"],
        "rates": lambda: f"{row['agent']} at {row['control_hz']:g} Hz",
        "replan": lambda: f"every {row['replan_every']}",
    }[part]()
    return f"{part}, {point}: mean return {row['mean_return']:.1f}"
