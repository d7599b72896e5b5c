"""`scripts/eval.py`: what a trained agent earns in closed loop, how long it thinks, and a film of it.

Torch and the simulator are imported when a rollout needs them, so that `--help` and bad input answer at once.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import tempfile
from argparse import SUPPRESS
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from latentplan.cli import read_flags, run_guarded
from latentplan.compose import build_config, field_names, raise_unknown
from latentplan.config import DEVICES, EnvConfig, PlannerConfig, UserError, from_dict, to_dict

if TYPE_CHECKING:
    import gymnasium

    from latentplan.envs.suite import SuiteEnv
    from latentplan.latency import Latency
    from latentplan.rollout import Agent, OnStep
    from latentplan.timed_rollout import TimedEpisode
    from latentplan.virtual_clock import VirtualClock

PLANNING_MODES = ("planner", "gated", "background")
GOAL_MODES = ("planner", "gated")  # who pursues an objective; the others are scored on it
MODES = (*PLANNING_MODES, "actor", "random")
FLAGS = {
    "--checkpoint": ("DIR", "folder of a trained agent, or of a run (its best checkpoint)"),
    "--episodes": ("N", "episodes to play (10)"),
    "--objective": (
        "TEXT",
        "what counts instead of the task, such as 'speed -> 2.0 and height > 1.1' (docs/zero-shot.md)",
    ),
    "--constraint": ("TEXT", "what must hold at every moment, such as 'cart < 0.5'; may be repeated"),
    "--mode": ("|".join(MODES), "who acts (planner)"),
    "--video": ("FILE", "film of the first episode, .mp4 or .webm"),
    "--json": ("FILE", "result as JSON"),
    "--control-hz": ("F", "decisions per second of a world that goes on while the agent thinks (it waits)"),
    "--latency": ("measured|FILE", "what thinking costs there: as measured, or drawn from a file of ms (measured)"),
    "--seed": ("S", "episode i starts from a state that depends only on S and i (0)"),
    "--device": ("|".join(DEVICES), "where the agent computes (auto: cuda where usable)"),
    "--threads": ("N", "CPU threads (torch's own choice)"),
}


@dataclass(frozen=True)
class EvaluationRequest:
    """What the command line asks for.

    Attributes:
        checkpoint: Folder of the agent.
        episodes: Episodes to play.
        objective: What counts instead of the task, or None.
        constraint: What must hold at every moment, or None.
        mode: One of `MODES`.
        planner: Planner settings that replace the agent's, as they were typed.
        video: Where the film goes, or None.
        json: Where the result goes, or None.
        control_hz: Decisions per second of a world that does not wait, or None for one that does.
        latency: What thinking costs there.
        seed: Seed of the starts.
        device: `auto`, `cpu` or `cuda`.
        threads: CPU threads, or None to leave it to torch.
    """

    checkpoint: Path
    episodes: int
    objective: str | None
    constraint: str | None
    mode: str
    planner: dict[str, str]
    video: Path | None
    json: Path | None
    control_hz: float | None
    latency: Latency
    seed: int
    device: str
    threads: int | None


def main(argv: Sequence[str] | None = None) -> int:
    """Run `scripts/eval.py` and return the exit code: 0, 2 for bad input, 130 when interrupted."""
    return run_guarded(_evaluate, sys.argv[1:] if argv is None else argv)


def evaluate_agent(
    agent: Agent, env: gymnasium.Env[Any, Any], seed: int, episodes: int, *, on_step: OnStep | None = None
) -> dict[str, Any]:
    """Plays episodes whose starts depend only on `seed` and their index.

    Returns:
        `seed`, and what `latentplan.rollout.summarize` gives.

    Raises:
        ValueError: `episodes` is below 1.
    """
    from latentplan.rollout import episode_seed, run_episodes, summarize

    seeds = [episode_seed(seed, index) for index in range(episodes)]
    return {"seed": seed, **summarize(run_episodes(env, agent, seeds, on_step=on_step))}


def parse_arguments(argv: Sequence[str]) -> EvaluationRequest:
    """Read the command line.

    Raises:
        UserError: A flag or value is wrong, or an output path cannot be written; the message says what to give.
    """
    settings = [f"--planner.{name}" for name in field_names("planner")]
    flags = read_flags(argv, [*FLAGS, *settings], {"--constraint": "; "})
    if "--checkpoint" not in flags:
        raise UserError("flag --checkpoint is missing; give the folder of a trained agent or of a run")
    mode, device = flags.get("--mode", "planner"), flags.get("--device", "auto")
    if mode not in MODES:
        raise_unknown("mode", mode, MODES)
    if device not in DEVICES:
        raise_unknown("device", device, DEVICES)
    planner = {name.removeprefix("--planner."): value for name, value in flags.items() if name in settings}
    if planner and mode not in PLANNING_MODES:
        raise UserError(f"--planner.{next(iter(planner))} has no effect in mode {mode}; use --mode planner")
    from latentplan.latency import read_clock_flags

    control_hz, latency = read_clock_flags(flags)
    if mode == "background" and ("--objective" in flags or "--constraint" in flags):
        raise UserError("mode background plans for the learned return alone; give goals to --mode planner or gated")
    return EvaluationRequest(
        checkpoint=Path(flags["--checkpoint"]),
        episodes=_whole_number(flags, "--episodes", 10, 1),
        objective=flags.get("--objective"),
        constraint=flags.get("--constraint"),
        mode=mode,
        planner=planner,
        video=_output_path(flags, "--video"),
        json=_output_path(flags, "--json"),
        control_hz=control_hz,
        latency=latency,
        seed=_whole_number(flags, "--seed", 0, 0),
        device=device,
        threads=_whole_number(flags, "--threads", 1, 1) if "--threads" in flags else None,
    )


def _evaluate(argv: Sequence[str]) -> int:
    if "-h" in argv or "--help" in argv:
        print(_help())
        return 0
    request = parse_arguments(argv)
    from latentplan.checkpoint import read_info
    from latentplan.timed_rollout import load_timed_agent
    from latentplan.virtual_clock import VirtualClock

    info = read_info(request.checkpoint)
    try:
        config = from_dict(info["config"])
    except ValueError as error:
        raise UserError(f"{request.checkpoint} has settings of another version: {error}") from None
    planner = build_config({"planner": {**to_dict(config.planner), **request.planner}}).planner
    overrides = {name: getattr(planner, name) for name in request.planner}
    device = _choose_device(request)
    from latentplan.envs import make_env
    from latentplan.scoring import read_goals, score_env

    goals = read_goals(request.objective, request.constraint, config.env.domain)
    env = make_env(config.env)
    try:
        clock = VirtualClock(request.control_hz, request.latency)
        agent = load_timed_agent(request.checkpoint, request.mode, clock, device, **overrides)
        about = _describe(request, info, config.env, planner)
        print(
            f"{about['domain']}-{about['task']}, {request.mode} on {device}, pictures by {about['renderer']}",
            flush=True,
        )
        played = env if goals is None else score_env(env, goals, agent if request.mode in GOAL_MODES else None)
        return _play_and_report(request, played, agent, about, planner.horizon, clock)
    except OSError as error:
        raise UserError(f"an output could not be written: {error}") from error
    finally:
        env.close()


def _play_and_report(
    request: EvaluationRequest, env: SuiteEnv, agent: Any, about: dict[str, Any], horizon: int, clock: VirtualClock
) -> int:
    """Plays, prints, writes; an interrupt reports the episodes that were finished."""
    from latentplan.rollout import episode_seed
    from latentplan.scoring import ScoredEnv
    from latentplan.timed_rollout import iterate_timed_episodes, summarize_timed

    scored = env if isinstance(env, ScoredEnv) else None
    seeds = [episode_seed(request.seed, index) for index in range(request.episodes)]
    episodes: list[TimedEpisode] = []
    interrupted = False
    with contextlib.ExitStack() as stack:
        on_step = None
        if request.video is not None:
            from latentplan.reporting.film import filming

            planner = agent if request.mode in PLANNING_MODES else None
            on_step = stack.enter_context(filming(request.video, env, planner, horizon, judge=scored))
        try:
            for episode in iterate_timed_episodes(env, agent, seeds, clock, on_step=on_step):
                episodes.append(episode)
                print(f"episode {len(episodes)} of {len(seeds)}: return {episode.total_return:.1f}", flush=True)
        except KeyboardInterrupt:
            interrupted = True
            print(f"\ninterrupted after {len(episodes)} of {len(seeds)} episodes", flush=True)
        if episodes:
            scores = {} if scored is None else scored.summarize(len(episodes))
            _report(request, {**about, **summarize_timed(episodes, clock), **scores})
    return 130 if interrupted else 0


def _describe(
    request: EvaluationRequest, info: dict[str, Any], env: EnvConfig, planner: PlannerConfig
) -> dict[str, Any]:
    from latentplan.envs import render_info

    described = {
        "domain": info["domain"],
        "task": info["task"],
        "mode": request.mode,
        "seed": request.seed,
        "env_frames_trained": int(info["env_frames"]),
        "render_quality": env.render_quality,
        "renderer": render_info()["renderer"],
    }
    return {**described, "planner": to_dict(planner)} if request.mode in PLANNING_MODES else described


def _report(request: EvaluationRequest, result: dict[str, Any]) -> None:
    low, high = result["ci95"]
    interval = "no interval from one episode" if low is None else f"95 % interval {low:.1f} to {high:.1f}"
    latency = "   ".join(f"{name} {value:.2f}" for name, value in result["decision_ms"].items())
    print(f"mean return {result['mean_return']:.1f}  ({interval}; episodes: {result['episodes']})")
    if "objective_return" in result:
        print(f"objective return {result['objective_return']:.1f}  ({result['objective']})")
    if "violation_rate" in result:
        print(f"violation rate {result['violation_rate']:.4f}  ({result['constraint']})")
    print(f"decision ms  {latency}", flush=True)
    if result["control_hz"] is not None:
        sources = "   ".join(f"{name} {count}" for name, count in result["action_source"].items())
        print(f"at {result['control_hz']:g} Hz  deadline misses {result['deadline_misses']}   {sources}", flush=True)
    if request.json is not None:
        partial = request.json.with_name(f".{request.json.name}.{os.getpid()}")
        partial.write_text(json.dumps(result, indent=2) + "\n")
        partial.replace(request.json)


def _choose_device(request: EvaluationRequest) -> str:
    import torch

    if request.threads is not None:
        torch.set_num_threads(request.threads)
    if request.device == "cuda" and not torch.cuda.is_available():
        raise UserError("device 'cuda' is not usable here; give --device cpu")
    return "cuda" if request.device == "auto" and torch.cuda.is_available() else request.device.replace("auto", "cpu")


def _whole_number(flags: dict[str, str], name: str, default: int, least: int) -> int:
    text = flags.get(name, str(default))
    if not text.isascii() or not text.isdigit() or int(text) < least:
        raise UserError(f"{name} must be a whole number of at least {least}, got {text!r}")
    return int(text)


def _output_path(flags: dict[str, str], name: str) -> Path | None:
    """The path of an output, tried before any work is spent on what goes there."""
    if name not in flags:
        return None
    path = Path(flags[name])
    if name == "--video":
        from latentplan.reporting.video import check_video_path

        check_video_path(path)
    if path.is_dir():
        raise UserError(f"{name} {str(path)!r} is a folder; give a file in it")
    folder = path.parent
    if not folder.is_dir():
        existing = next(parent for parent in folder.parents if parent.is_dir())
        raise UserError(f"{name}: there is no folder {str(folder)!r}; the nearest that exists is {str(existing)!r}")
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise UserError(f"{name}: cannot write in {str(folder)!r}: {error.strerror}; choose another folder") from None
    return path


def _help() -> str:
    from jsonargparse import ArgumentParser

    parser = ArgumentParser(prog="eval.py", usage="%(prog)s --checkpoint DIR [--name value ...]")
    parser.description = "Play a trained agent in closed loop: return, decision latency, film."
    parser.epilog = (
        "Planner defaults shown are the program's; a checkpoint brings its own, which hold unless given here."
    )
    for flag, (metavar, meaning) in FLAGS.items():
        parser.add_argument(flag, metavar=metavar, default=SUPPRESS, help=meaning)
    parser.add_argument("--planner", type=PlannerConfig)
    parser._option_string_actions["--planner"].help = SUPPRESS
    return parser.format_help()
