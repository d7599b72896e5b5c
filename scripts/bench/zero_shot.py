"""`benchmark.py zero-shot --checkpoint DIR --objectives "A | B"`: goals that the agent was not trained for.

Every objective and constraint is played by planner, gated agent, actor and random actions from the same starts. A
score is the return of the objective, or for a constraint the share of env frames that violate it, both from the true
quantities of the simulator; decision times are in milliseconds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from bench.report import format_interval, format_number, format_table, write_json
from bench.workers import run_in_order
from latentplan.commands.flags import overrides
from latentplan.commands.shell import ComputeRequest, check_search, search_settings
from latentplan.config import EnvConfig, PlannerConfig, UserError, to_dict
from latentplan.config.checks import above_zero, at_least
from latentplan.config.parsing import option, require_known
from latentplan.objectives.parser import split_outside_quotes

if TYPE_CHECKING:
    from latentplan.envs import SuiteEnv
    from latentplan.evaluation.episodes import Step

PUSH_PROBABILITY = 0.04  # per decision
PLANNING_PLAYERS = ("planner", "gated", "random moments", "random gate")
OBJECTIVE_PLAYERS = (*PLANNING_PLAYERS, "actor", "random")
CONSTRAINT_PLAYERS = (*PLANNING_PLAYERS, "unconstrained", "actor", "random")
TRAINED_PLAYERS = ("trained planner", "trained actor")  # agents of another checkpoint, without a new goal


class Job(NamedTuple):
    """One row of the result.

    Attributes:
        objective: Objective that is scored, or None.
        constraint: Constraint that is scored, or None.
        player: Name of the agent; see `load_zero_shot_agent`. `unconstrained` is a planner without the constraint;
            `trained planner` and `trained actor` are agents of another checkpoint, without objective and constraint.
    """

    objective: str | None
    constraint: str | None
    player: str


class Conditions(NamedTuple):
    """Conditions that all rows share.

    Attributes:
        checkpoint: Folder of the agent or run.
        seeds: Seed of the start of each episode.
        device: Device of the agent, `cpu` or `cuda`.
        planner: Settings of the search that differ from the agent's.
        push: Standard deviation of kicks to the joints' velocities, in m/s or rad/s; 0 for none.
        trained: Folder of the agent that was trained for the objectives, or None.
        threads: CPU threads.
    """

    checkpoint: str
    seeds: Sequence[int]
    device: str
    planner: dict[str, Any]
    push: float = 0.0
    trained: str | None = None
    threads: int = 1


@dataclass(frozen=True, kw_only=True)
class Request(ComputeRequest):
    """Flags of `benchmark.py zero-shot`.

    Attributes:
        checkpoint: Folder of a trained agent, or of a run (its best checkpoint).
        objectives: Objectives as in `eval`, separated by |.
        constraints: Constraints as in `eval`, separated by |; the objective is the objective of the training.
        players: Rows of each goal, among planner, gated, random moments, random gate, unconstrained, actor, random.
        trained: Agent trained for the goals, for comparison: adds a row for its planner and one for its actor.
        episodes: Episodes of each row, from the same starts.
        seed: Seed of the starts: episode i starts from a state that depends only on the seed and i.
        push: Standard deviation of kicks to all joint velocities, at one decision in 25, the same for every player.
        workers: Rows that are played at once, each in its own process.
        json: Result as JSON.
        planner: Settings of the search, in place of the agent's own.
    """

    checkpoint: Path = option(metavar="DIR")
    objectives: str = option("", metavar='"A | B"')
    constraints: str = option("", metavar='"A | B"')
    players: tuple[str, ...] = option((*OBJECTIVE_PLAYERS, "unconstrained"), separator=",")
    trained: Path | None = option(None, metavar="DIR")
    episodes: int = 10
    seed: int = 0
    push: float | None = None
    workers: int = 1
    json: Path | None = option(None, metavar="FILE", is_output=True)
    planner: dict[str, Any] = overrides(PlannerConfig, prefix="planner.")

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, episodes=1, seed=0, workers=1)
        above_zero(self, "push")


def run(request: Request) -> int:
    """Plays every goal with every player from the same starts."""
    checkpoint, episodes, seed = str(request.checkpoint), request.episodes, request.seed
    workers, push = request.workers, request.push or 0.0
    jobs = list_jobs(request)
    from latentplan.agents.checkpoint import load_model

    _, trained, info = load_model(request.checkpoint)
    _check_goals(jobs, info["config"]["env"]["domain"])
    trained_for = None if request.trained is None else str(request.trained)
    if trained_for is not None:
        domain = load_model(trained_for)[2]["domain"]
        if domain != info["domain"]:
            raise UserError(f"--trained {trained_for!r} controls {domain}, --checkpoint {info['domain']}")
    planner = search_settings(trained, request.planner)
    if request.planner:
        check_search(planner, trained.model)
    changes = {name: getattr(planner, name) for name in request.planner}
    device = request.use_device()
    from latentplan.agents.info import require_unchanged
    from latentplan.evaluation.episodes import episode_seed
    from latentplan.evaluation.goals import goal_env

    seeds = [episode_seed(seed, index) for index in range(episodes)]
    about = {
        "checkpoint": checkpoint,
        "domain": info["domain"],
        "task": info["task"],
        "env_frames_trained": info["env_frames"],
        "render_quality": info["config"]["env"]["render_quality"],
        "planner": to_dict(planner),
        "seed": seed,
        "episodes": episodes,
        "push": push,
        "floor": goal_env(EnvConfig()).floor,
        "trained": trained_for,
    }
    print(f"{about['domain']}-{about['task']}, {episodes} episodes per row, {workers} at once", flush=True)
    rows: list[dict[str, Any]] = []
    conditions = Conditions(checkpoint, seeds, device, changes, push, trained_for, request.threads or 1)
    for row in run_in_order(partial(play_job, conditions), jobs, workers):
        require_unchanged(checkpoint, info)
        rows.append(row)
        print(f"{row['goal']}, {row['player']}: {format_number(row['mean'], row['digits'])}", flush=True)
        write_json(request.json, {**about, "rows": rows})
    print(summary_table(rows))
    return 0


def list_jobs(request: Request) -> list[Job]:
    """The rows of a request.

    Raises:
        UserError: There is no row, or a player is unknown.
    """
    objectives, constraints = _split_goals(request.objectives), _split_goals(request.constraints)
    if not objectives and not constraints:
        raise UserError("give --objectives 'height > 1.2 | speed -> 2.0' or --constraints 'cart < 0.5', or both")
    known = (*OBJECTIVE_PLAYERS, "unconstrained")
    wanted = request.players
    require_known("player", wanted, known)
    trained = TRAINED_PLAYERS if request.trained is not None else ()
    asked = [name for name in (*OBJECTIVE_PLAYERS, *trained) if name in (*wanted, *trained)]
    jobs = [
        *(Job(text, None, name) for text in objectives for name in asked),
        *(
            Job(None, text, name)
            for text in constraints
            for name in (*CONSTRAINT_PLAYERS, *trained)
            if name in (*wanted, *trained)
        ),
    ]
    if not jobs:
        raise UserError("--players names no agent that plays for an objective; unconstrained is for constraints")
    return jobs


def play_job(conditions: Conditions, job: Job) -> dict[str, Any]:
    """Plays one episode per seed and scores it by the true quantities of the simulator.

    Returns:
        The row: `goal`, `kind` (`objective` or `constraint`), `player`, the score of each episode in `scores`
        (objective return, or violation rate), their `mean` and `ci95`, the mean of every true quantity in
        `quantities`, the task's `returns` and `mean_return` with `return_ci95`, `planned_fraction` and `decision_ms`.
    """
    import torch

    from bench.estimates import mean_estimate
    from bench.zero_shot_agents import load_zero_shot_agent
    from latentplan.agents.checkpoint import load_model
    from latentplan.envs import make_env
    from latentplan.evaluation.episodes import run_episodes
    from latentplan.evaluation.goals import goal_env, read_goals, score_env
    from latentplan.evaluation.statistics import summarize

    torch.set_num_threads(conditions.threads)
    checkpoint, player, search = conditions.checkpoint, job.player, conditions.planner
    if job.player in TRAINED_PLAYERS:
        assert conditions.trained is not None, "asked for by --trained"
        checkpoint, player, search = conditions.trained, job.player.removeprefix("trained "), {}
    _, config, _ = load_model(checkpoint)
    own = config if checkpoint == conditions.checkpoint else load_model(conditions.checkpoint)[1]
    agent = load_zero_shot_agent(player, checkpoint, conditions.device, search)
    goals = read_goals(job.objective, job.constraint, config.env.domain)
    assert goals is not None, "a job names an objective or a constraint"
    # Each agent plays in the environment of its own training, but all with the reward of the same task.
    env = make_env(replace(goal_env(config.env), task=own.env.task, objective=own.env.objective))
    try:
        scored = score_env(env, goals, agent if job.player in PLANNING_PLAYERS else None)
        result = summarize(run_episodes(scored, agent, conditions.seeds, on_step=_make_pusher(env, conditions)))
    finally:
        env.close()
    is_objective = job.objective is not None
    scores = [score.objective_return if is_objective else score.violation_rate for score in scored.scores]
    estimate = mean_estimate(scores)
    return {
        "goal": job.objective or job.constraint,
        "kind": "objective" if is_objective else "constraint",
        "player": job.player,
        "scores": scores,
        "mean": estimate.mean,
        "ci95": [estimate.low, estimate.high],
        "digits": 1 if is_objective else 4,
        "quantities": scored.summarize(len(conditions.seeds))["quantities"],
        "returns": result["returns"],
        "mean_return": result["mean_return"],
        "return_ci95": result["ci95"],
        "planned_fraction": result["action_source"]["plan"] / sum(result["action_source"].values()),
        "decision_ms": result["decision_ms"],
    }


def summary_table(rows: Sequence[dict[str, Any]]) -> str:
    """The rows as a text table; scores are objective returns, or for constraints violation rates."""
    header = ["goal", "player", "score", "95 %", "task return", "95 %", "planned", "ms p50"]
    lines = [
        [
            f"{row['goal']} ({row['kind']})",
            row["player"],
            format_number(row["mean"], row["digits"]),
            format_interval(row["ci95"], row["digits"]),
            format_number(row["mean_return"]),
            format_interval(row["return_ci95"]),
            f"{100.0 * row['planned_fraction']:.0f} %",
            format_number(row["decision_ms"]["p50"], 2),
        ]
        for row in rows
    ]
    return format_table(header, lines)


def _split_goals(text: str) -> list[str]:
    return list(dict.fromkeys(part.strip() for part in split_outside_quotes(text, "|") if part.strip()))


def _check_goals(jobs: Sequence[Job], domain: str) -> None:
    from latentplan.evaluation.goals import read_goals

    for job in jobs:
        read_goals(job.objective, job.constraint, domain)


def _make_pusher(env: SuiteEnv, conditions: Conditions) -> Callable[[Step], None] | None:
    """A callback that kicks the body before decisions; kicks depend on the episode's seed and the decision only."""
    if conditions.push == 0.0:
        return None
    import numpy as np

    def push(step: Step) -> None:
        draw = np.random.default_rng((conditions.seeds[step.episode], step.decision))
        if step.action is not None and draw.random() < PUSH_PROBABILITY:
            velocities = env.physics.data.qvel
            velocities += conditions.push * draw.normal(size=velocities.shape)

    return push
