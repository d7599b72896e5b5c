"""`benchmark.py ablate --checkpoint DIR`: the return of a trained planner with one part left out in each arm.

All arms play the same starts, so the table shows paired differences of episode returns, with 95 % intervals; decision
times are in milliseconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from bench.ablation_arms import NAMES, REFERENCE, Outcome, parse_arms, play_arm
from bench.report import format_interval, format_number, format_table, write_csv, write_json
from bench.workers import run_in_order
from latentplan.commands.shell import ComputeRequest
from latentplan.config import to_dict
from latentplan.config.checks import at_least
from latentplan.config.parsing import option


@dataclass(frozen=True, kw_only=True)
class Request(ComputeRequest):
    """Flags of `benchmark.py ablate`.

    Attributes:
        checkpoint: Folder of a trained agent, or of a run (its best checkpoint).
        episodes: Episodes of each arm, from the same starts.
        seed: Seed of the starts: episode i starts from a state that depends only on the seed and i.
        arms: Arms, separated by commas: known names, or name:field=value,field=value for settings of the search.
        workers: Arms that play at once, each in its own process.
        json: Result as JSON.
        csv: Every episode as CSV.
    """

    checkpoint: Path = option(metavar="DIR")
    episodes: int = 20
    seed: int = 0
    arms: str = ",".join(NAMES)
    workers: int = 1
    json: Path | None = option(None, metavar="FILE", is_output=True)
    csv: Path | None = option(None, metavar="FILE", is_output=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, episodes=1, seed=0, workers=1)


def run(request: Request) -> int:
    """Plays every arm from the same starts and compares the arms with the full planner."""
    episodes, seed, workers, checkpoint = request.episodes, request.seed, request.workers, str(request.checkpoint)
    from latentplan.agents.checkpoint import load_model

    _, config, info = load_model(request.checkpoint)
    planner = config.planner
    arms = parse_arms(request.arms, planner)
    device = request.use_device()
    from latentplan.agents.info import require_unchanged
    from latentplan.evaluation.episodes import episode_seed

    seeds = [episode_seed(seed, index) for index in range(episodes)]
    about = {
        "checkpoint": checkpoint,
        "domain": info.get("domain"),
        "task": info.get("task"),
        "env_frames_trained": info.get("env_frames"),
        "render_quality": info["config"]["env"]["render_quality"],
        "planner": to_dict(planner),
        "seed": seed,
        "episodes": episodes,
    }
    print(f"{about['domain']}-{about['task']}, {episodes} episodes per arm, {workers} at once", flush=True)
    outcomes: dict[str, Outcome] = {}
    play = partial(play_arm, checkpoint=checkpoint, seeds=seeds, device=device, threads=request.threads or 1)
    for outcome in run_in_order(play, arms, workers):
        require_unchanged(checkpoint, info)
        outcomes[outcome.arm.name] = outcome
        print(f"{outcome.arm.name}: mean return {sum(outcome.returns) / episodes:.1f}", flush=True)
        write_csv(request.csv, episode_rows(list(outcomes.values()), seeds))
        write_json(request.json, {**about, "arms": compare_arms(list(outcomes.values()))})
    print(summary_table(compare_arms(list(outcomes.values()))))
    return 0


def compare_arms(outcomes: Sequence[Outcome]) -> dict[str, dict[str, Any]]:
    """The mean return of each arm and its paired difference to the first arm, as plain values."""
    from bench.estimates import mean_estimate, paired_difference

    reference = outcomes[0].returns
    compared = {}
    for outcome in outcomes:
        mean, difference = mean_estimate(outcome.returns), paired_difference(outcome.returns, reference)
        is_reference = outcome.arm.name == REFERENCE
        compared[outcome.arm.name] = {
            "mode": outcome.arm.mode,
            "planner": outcome.arm.planner,
            "returns": outcome.returns,
            "mean_return": mean.mean,
            "ci95": [mean.low, mean.high],
            "minus_full": None if is_reference else difference.mean,
            "minus_full_ci95": [None, None] if is_reference else [difference.low, difference.high],
            "decision_ms": outcome.decision_ms,
            "differs_from_actor": outcome.differs_from_actor,
        }
    return compared


def summary_table(compared: dict[str, dict[str, Any]]) -> str:
    """The comparison as a text table."""
    header = ["arm", "return", "95 %", "minus full", "95 %", "ms p50", "differs from actor"]
    rows = []
    for name, facts in compared.items():
        share = facts["differs_from_actor"]
        rows.append(
            [
                name,
                format_number(facts["mean_return"]),
                format_interval(facts["ci95"]),
                format_number(facts["minus_full"], sign=True),
                format_interval(facts["minus_full_ci95"], sign=True),
                format_number(facts["decision_ms"]["p50"], 2),
                "-" if share is None else f"{100.0 * share:.0f} %",
            ]
        )
    return format_table(header, rows)


def episode_rows(outcomes: Sequence[Outcome], seeds: Sequence[int]) -> list[dict[str, Any]]:
    """Rows of the CSV file: one per arm and episode."""
    return [
        {"arm": outcome.arm.name, "episode": index, "start_seed": seed, "return": total, "decision_ms_p50": median_ms}
        for outcome in outcomes
        for index, (seed, total, median_ms) in enumerate(zip(seeds, outcome.returns, outcome.episode_ms, strict=True))
    ]
