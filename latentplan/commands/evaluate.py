"""`scripts/eval.py`: what a trained agent earns in closed loop, how long it thinks, and a film of it.

Torch and the simulator are imported when a rollout needs them, so that `--help` and bad input answer at once.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from latentplan.commands.evaluation_request import (
    PLANNING_MODES,
    EvaluationRequest,
    help_text,
    parse_arguments,
)
from latentplan.commands.main import run_guarded, use_device
from latentplan.config import EnvConfig, PlannerConfig, UserError, from_dict, to_dict
from latentplan.config.files import build_config
from latentplan.config.planner import override_planner

if TYPE_CHECKING:
    from latentplan.envs.suite import SuiteEnv
    from latentplan.evaluation.clock import VirtualClock
    from latentplan.evaluation.goals import Goals, ScoredEnv
    from latentplan.evaluation.statistics import Episode

ON_ONE_THREAD = ("actor", "background")  # more would only wait for each other at a single frame


def main(argv: Sequence[str] | None = None) -> int:
    """Run `scripts/eval.py` and return the exit code: 0, 2 for bad input, 130 when interrupted."""
    return run_guarded(_evaluate, sys.argv[1:] if argv is None else argv)


def _evaluate(argv: Sequence[str]) -> int:
    if "-h" in argv or "--help" in argv:
        print(help_text())
        return 0
    request = parse_arguments(argv)
    from latentplan.agents.checkpoint import read_info
    from latentplan.evaluation.clock import VirtualClock
    from latentplan.evaluation.timed import load_timed_agent

    info = read_info(request.checkpoint)
    try:
        config = from_dict(info["config"])
    except (AttributeError, TypeError, ValueError) as error:
        raise UserError(f"{request.checkpoint} has settings of another version: {error}") from None
    planner = build_config({"planner": override_planner(to_dict(config.planner), request.planner)}).planner
    overrides = {name: getattr(planner, name) for name in request.planner}
    if request.planning_budget is not None:
        overrides["planning_budget"] = request.planning_budget
    device = use_device(request.device, request.threads or (1 if request.mode in ON_ONE_THREAD else None))
    from latentplan.envs import make_env
    from latentplan.evaluation.goals import goal_env, read_goals, score_env

    goals = read_goals(request.objective, request.constraint, config.env.domain)
    world = config.env if goals is None else goal_env(config.env)
    env = make_env(world)
    try:
        clock = VirtualClock(request.control_hz, request.latency)
        agent = load_timed_agent(request.checkpoint, request.mode, clock, device, **overrides)
        about = _describe(request, info, world, planner, goals)
        print(
            f"{about['domain']}-{about['task']}, {request.mode} on {device}, pictures by {about['renderer']}",
            flush=True,
        )
        played = env if goals is None else score_env(env, goals, agent if request.mode in PLANNING_MODES else None)
        try:
            return _play_and_report(request, played, agent, about, clock)
        except OSError as error:
            raise UserError(f"an output could not be written: {error}") from error
    finally:
        env.close()


def _play_and_report(
    request: EvaluationRequest,
    env: SuiteEnv | ScoredEnv,
    agent: Any,
    about: dict[str, Any],
    clock: VirtualClock,
) -> int:
    """Plays, prints, writes; an interrupt reports the episodes that were finished."""
    from latentplan.evaluation.episodes import episode_seed
    from latentplan.evaluation.goals import ScoredEnv
    from latentplan.evaluation.timed import iterate_timed_episodes, summarize_timed

    scored = env if isinstance(env, ScoredEnv) else None
    seeds = [episode_seed(request.seed, index) for index in range(request.episodes)]
    episodes: list[Episode] = []
    interrupted = False
    with contextlib.ExitStack() as stack:
        on_step = None
        if request.video is not None:
            from latentplan.reporting.film import filming

            planner = agent if request.mode in PLANNING_MODES else None
            on_step = stack.enter_context(filming(request.video, env, planner, goals=scored))
        try:
            for episode in iterate_timed_episodes(env, agent, seeds, clock, on_step=on_step):
                episodes.append(episode)
                print(f"episode {len(episodes)} of {len(seeds)}: return {episode.total_return:.1f}", flush=True)
        except KeyboardInterrupt:
            interrupted = True
            print(f"\ninterrupted after {len(episodes)} of {len(seeds)} episodes", flush=True)
        if episodes:
            scores = {} if scored is None else scored.summarize(len(episodes))
            result = {**about, **summarize_timed(episodes, clock), **scores}
            if request.mode == "gated":  # where a plan goes on none was made
                result["planned_fraction"] = result["action_source"]["plan"] / sum(result["action_source"].values())
            if request.mode == "planner" and agent.surprise_limit is not None:
                result["surprised"] = sum(episode.surprised for episode in episodes)
            _report(request, result)
    return 130 if interrupted else 0


def _describe(
    request: EvaluationRequest, info: dict[str, Any], env: EnvConfig, planner: PlannerConfig, goals: Goals | None
) -> dict[str, Any]:
    from latentplan.envs import render_info

    described = {
        "domain": info["domain"],
        "task": info["task"],
        "mode": request.mode,
        "seed": request.seed,
        "env_frames_trained": int(info["env_frames"]),
        "render_quality": env.render_quality,
        "floor": env.floor,
        "renderer": render_info()["renderer"],
    }
    if request.mode not in PLANNING_MODES:
        return described
    is_own = goals is None or (any(phase.objective.is_return for phase in goals.phases) and not goals.constraints)
    if request.mode != "planner" or not is_own:
        planner = dataclasses.replace(planner, surprise_limit=None)  # which is not heeded then
    return {**described, "planner": to_dict(planner)}


def _report(request: EvaluationRequest, result: dict[str, Any]) -> None:
    low, high = result["ci95"]
    interval = "no interval from one episode" if low is None else f"95 % interval {low:.1f} to {high:.1f}"
    latency = "   ".join(f"{name} {value:.2f}" for name, value in result["decision_ms"].items())
    print(f"mean return {result['mean_return']:.1f}  ({interval}; episodes: {result['episodes']})")
    if "objective_return" in result:
        print(f"objective return {result['objective_return']:.1f}  ({result['objective']})")
    if "violation_rate" in result:
        print(f"violation rate {result['violation_rate']:.4f}  ({result['constraint']})")
    if result.get("quantities"):  # some domains have none
        means = "   ".join(f"{name} {value:.2f}" for name, value in result["quantities"].items())
        print(f"on average   {means}")
    print(f"decision ms  {latency}", flush=True)
    surprised = result.get("surprised", 0)
    if surprised:
        decisions = sum(result["action_source"].values())
        print(f"surprised    {surprised} of {decisions} decisions are its actor's", flush=True)
    failed = result["action_source"]["tail"] + result["action_source"]["actor"] - surprised
    if failed and request.mode == "planner":
        why = "the search found nothing finite"
        if result["planner"]["deadline_ms"] is not None:
            why = f"there was no time for a search, or {why}"
        print(f"warning: at {failed} decisions {why}", file=sys.stderr, flush=True)
    if result["control_hz"] is not None:
        sources = "   ".join(f"{name} {count}" for name, count in result["action_source"].items())
        print(f"at {result['control_hz']:g} Hz  deadline misses {result['deadline_misses']}   {sources}", flush=True)
    if request.json is not None:
        partial = request.json.with_name(f".{request.json.name}.{os.getpid()}")
        partial.write_text(json.dumps(result, indent=2) + "\n")
        partial.replace(request.json)
