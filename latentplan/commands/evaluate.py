"""`latentplan eval`: play a trained agent in closed loop; report return and decision latency, and film an episode.

Torch and the simulator are imported when the first episode needs them, so that `--help` and bad input answer at once.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from latentplan.commands.flags import overrides
from latentplan.commands.shell import ComputeRequest, check_search, read_search, saved_config, search_settings
from latentplan.config import USER_DOMAIN, EnvConfig, PlannerConfig, UserError, to_dict
from latentplan.config.checks import MAX_EPISODES, above_zero, at_least, one_of, within
from latentplan.config.env_id import ENV_FLAGS, EnvChoice, choose_env, is_by_id, require_imported
from latentplan.config.origin import present_facts
from latentplan.config.parsing import option
from latentplan.config.suites import check_task
from latentplan.config.writing import write_whole

if TYPE_CHECKING:
    from collections.abc import Sequence

    from latentplan.envs.suite import SuiteEnv
    from latentplan.evaluation.clock import VirtualClock
    from latentplan.evaluation.episodes import OnStep, Step
    from latentplan.evaluation.goals import Goals, ScoredEnv
    from latentplan.evaluation.statistics import Episode
    from latentplan.reporting.recorder import EpisodeRecorder

PAGE_FRAMES = 250  # of the film in a page


@dataclass(frozen=True, kw_only=True)
class Request(ComputeRequest):
    """The command line of an evaluation.

    Attributes:
        checkpoint: Folder of a trained agent, or of a run (its best checkpoint).
        episodes: Episodes to play.
        mode: Agent that chooses the actions.
        objective: Objective in place of the task, such as 'speed -> 2.0 and height > 1.1'.
        constraint: Condition that must hold at every moment, such as 'cart < 0.5'; may be repeated.
        planning_budget: Share of its decisions that a gated agent may plan, in [0, 1]; None takes the agent's own.
        video: Film of the first episode, .mp4 or .webm.
        json: Result as JSON.
        report: Page with film, returns, training curves, decision times, imagination and searches.
        keep_episodes: Folder for the episodes, one HDF5 file each, from which a run can learn.
        control_hz: Decisions per second of a world that goes on while the agent computes; None makes the world wait.
        latency: Time that a decision takes in a world that does not wait: `measured`, or a file of milliseconds.
        seed: Seed of the starts: episode i starts from a state that depends only on the seed and i.
        env: The environment, in place of the one that the agent learned in.
        planner: Settings of the search, in place of the agent's own.
    """

    NOTES = "Planner defaults shown are the program's; the settings of a checkpoint hold unless given here."

    checkpoint: Path = option(metavar="DIR")
    episodes: int = 10
    mode: str = option("planner", choices=lambda: list_modes())
    objective: str | None = None
    constraint: str | None = option(None, join="; ")
    planning_budget: float | None = None
    video: Path | None = option(None, metavar="FILE", is_output=True)
    json: Path | None = option(None, metavar="FILE", is_output=True)
    report: Path | None = option(None, metavar="FILE.html", is_output=True)
    keep_episodes: Path | None = option(None, metavar="DIR")
    control_hz: float | None = None
    latency: str | None = option(None, metavar="measured|FILE")
    seed: int = 0
    env: dict[str, Any] = overrides(EnvChoice, ENV_FLAGS, prefix="env.")
    planner: dict[str, Any] = overrides(PlannerConfig, prefix="planner.")

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, seed=0)
        within(self, episodes=(1, MAX_EPISODES))
        one_of(self, mode=list_modes())
        above_zero(self, "control_hz")
        if self.planner and self.mode not in planning_modes():
            raise UserError(
                f"--planner.{next(iter(self.planner))} has no effect in mode {self.mode}; use --mode planner"
            )
        if self.planning_budget is not None:
            within(self, planning_budget=(0.0, 1.0))
            if self.mode != "gated":
                raise UserError(f"--planning-budget has no effect in mode {self.mode}; use --mode gated")
        if self.keep_episodes is not None:
            changes = {
                "--control-hz": self.control_hz,
                "--objective": self.objective,
                "--constraint": self.constraint,
            }
            for flag, value in changes.items():
                if value is not None:
                    raise UserError(
                        f"--keep-episodes cannot be given with {flag}, which changes its actions or rewards"
                    )
        if self.latency is not None and self.control_hz is None:
            raise UserError("--latency has no effect in a world that waits; give --control-hz too")
        if self.video is not None:
            from latentplan.reporting.video import check_video_path

            check_video_path(self.video)


def list_modes() -> tuple[str, ...]:
    """The names of the modes that an agent can act in."""
    from latentplan.agents.modes import MODES

    return tuple(MODES)


def planning_modes() -> tuple[str, ...]:
    """The names of the modes that pursue an objective; the other modes are only scored on it."""
    from latentplan.agents.modes import planning_modes

    return planning_modes()


def resolve(request: Request) -> dict[str, Any]:
    """The fields of the request, with every setting of the search that the agent would use."""
    return {**vars(request), "planner": read_search(request.checkpoint, request.planner)}


def run(request: Request) -> int:
    """Play the episodes, print and write their results, and return the exit code.

    Raises:
        UserError: The checkpoint, an objective, the latency or an output cannot be used.
    """
    from latentplan.agents.info import read_info, require_unchanged
    from latentplan.config.latency import MEASURED, read_durations

    info = read_info(request.checkpoint)
    config = saved_config(request.checkpoint, info)
    chosen = choose_env(config.env, request.env)
    check_env(chosen)
    planner = search_settings(config, request.planner)
    if request.mode in planning_modes():
        check_search(planner, config.model)
    read_durations(request.latency or MEASURED)
    check_expressions(request.objective, request.constraint, chosen.domain)
    from latentplan.agents.modes import MODES
    from latentplan.evaluation.clock import VirtualClock, read_latency
    from latentplan.evaluation.timed import load_timed_agent

    latency = read_latency(request.latency or MEASURED)
    changes = {name: getattr(planner, name) for name in request.planner}
    if request.planning_budget is not None:
        changes["planning_budget"] = request.planning_budget
    device = request.use_device(threads=1 if MODES[request.mode].one_thread else None)
    from latentplan.evaluation.goals import goal_env, read_goals, score_env

    goals = read_goals(request.objective, request.constraint, chosen.domain)
    world = chosen if goals is None else goal_env(chosen)
    env = open_env(world, info)
    try:
        if request.keep_episodes is not None:
            from latentplan.training.collection.keeping import KeepingEnv

            env = KeepingEnv(env, request.keep_episodes, world, "--keep-episodes")
        clock = VirtualClock(request.control_hz, latency)
        agent = load_timed_agent(request.checkpoint, request.mode, clock, device, **changes)
        require_unchanged(request.checkpoint, info)
        about = _describe(request, info, world, planner, goals)
        print(
            f"{about['domain']}-{about['task']}, {request.mode} on {device}, pictures by {about['renderer']}",
            flush=True,
        )
        played = env if goals is None else score_env(env, goals, agent if request.mode in planning_modes() else None)
        try:
            return _play_and_report(request, played, agent, info, about, clock)
        except BrokenPipeError:
            raise
        except OSError as error:
            raise UserError(f"an output could not be written: {error}") from error
    finally:
        env.close()


def open_env(config: EnvConfig, info: dict[str, Any]) -> Any:
    """The environment to play in; one of the user's, whose code may fail, gives an error of one line.

    Args:
        config: Settings of the environment.
        info: Content of the `info.json` of the agent that plays.

    Raises:
        UserError: The environment cannot be made, or its actions or observations have another form than the agent's.
    """
    from latentplan.agents.info import read_spaces
    from latentplan.envs import make_env
    from latentplan.envs.vector import make_guarded_env
    from latentplan.evaluation.compatibility import refuse_other_spaces

    try:
        spaces = read_spaces(info)
    except (TypeError, ValueError) as error:
        raise UserError(f"the agent's info.json cannot be used: {error}") from None
    env = make_guarded_env(config) if is_by_id(config) else make_env(config)
    try:
        refuse_other_spaces(env, f"{config.domain}-{config.task}", info["action_dim"], spaces)
    except UserError:
        env.close()
        raise
    return env


def check_env(config: EnvConfig) -> None:
    """Refuses an environment that does not exist, or whose module nobody has imported, before torch is imported.

    Raises:
        UserError: There is no such environment, or its module has to be named again.
    """
    if config.domain != USER_DOMAIN:
        check_task(config.suite, config.domain, config.task)
        require_imported(config)


def check_expressions(objective: str | None, constraint: str | None, domain: str) -> None:
    """Refuses an objective or a constraint that is no expression, before torch is imported.

    Raises:
        UserError: A text is no expression over the domain's quantities, or a goal image cannot be read.
    """
    from latentplan.config.quantities import scales
    from latentplan.objectives.expression import GoalImage
    from latentplan.objectives.parser import parse_constraints, parse_schedule

    if objective is not None:
        for phase in parse_schedule(objective, scales(domain)):
            for _, term in phase.objective.terms:
                if isinstance(term, GoalImage):
                    from latentplan.objectives.goal_image import read_goal_image

                    read_goal_image(term.path)
    if constraint is not None:
        parse_constraints(constraint, scales(domain))


def _play_and_report(
    request: Request,
    env: SuiteEnv | ScoredEnv,
    agent: Any,
    info: dict[str, Any],
    about: dict[str, Any],
    clock: VirtualClock,
) -> int:
    """Play, print and write; after an interrupt, report the episodes that were finished."""
    from latentplan.evaluation.episodes import episode_seed
    from latentplan.evaluation.goals import ScoredEnv
    from latentplan.evaluation.timed import iterate_timed_episodes, summarize_timed

    scored = env if isinstance(env, ScoredEnv) else None
    seeds = [episode_seed(request.seed, index) for index in range(request.episodes)]
    episodes: list[Episode] = []
    interrupted = False
    with contextlib.ExitStack() as outputs:
        film, recorder = _page_parts(request, env, agent, clock, outputs)
        with contextlib.ExitStack() as stack:
            on_step = _watch(request, env, agent, film, recorder, stack)
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
                if request.mode == "gated":  # an action of an older plan needed no search
                    result["planned_fraction"] = result["action_source"]["plan"] / sum(result["action_source"].values())
                if request.mode == "planner" and agent.surprise_limit is not None:
                    result["surprised"] = sum(episode.surprised for episode in episodes)
                _report(request, result)
        if episodes and request.report is not None:
            _write_page(request, env, info, result, episodes, film, recorder)
    return 130 if interrupted else 0


def _page_parts(
    request: Request, env: Any, agent: Any, clock: VirtualClock, outputs: contextlib.ExitStack
) -> tuple[Path | None, EpisodeRecorder | None]:
    """The film that is made, and the recorder of the first episode, if a page is asked for."""
    if request.report is None:
        return request.video, None
    import tempfile

    from latentplan.reporting.recorder import EpisodeRecorder

    goals = env if hasattr(env, "objective_scores") else None
    length = getattr(env.unwrapped, "decisions_per_episode", None)
    recorder = EpisodeRecorder(agent, length, goals=goals, waits=clock.control_hz is None)
    if request.video is not None:
        return request.video, recorder
    return Path(outputs.enter_context(tempfile.TemporaryDirectory())) / "film.webm", recorder


def _watch(
    request: Request,
    env: Any,
    agent: Any,
    film: Path | None,
    recorder: EpisodeRecorder | None,
    stack: contextlib.ExitStack,
) -> OnStep | None:
    """The callback of every step, which films and records; None where nothing is watched."""
    if film is None:
        return None
    from latentplan.reporting.film import filming

    planner = agent if request.mode in planning_modes() else None
    length = getattr(env.unwrapped, "decisions_per_episode", None) or 0
    every = 1 if request.video is not None else -(-length // PAGE_FRAMES) or 1
    goals = env if hasattr(env, "objective_scores") else None
    write = stack.enter_context(filming(film, env, planner, every=every, goals=goals))

    def watch(step: Step) -> None:
        write(step)
        if recorder is not None:
            recorder(step)

    return watch


def _write_page(
    request: Request,
    env: Any,
    info: dict[str, Any],
    result: dict[str, Any],
    episodes: Sequence[Episode],
    film: Path | None,
    recorder: EpisodeRecorder | None,
) -> None:
    import numpy as np

    from latentplan.config.run_results import read_log
    from latentplan.evaluation.statistics import confidence_interval
    from latentplan.reporting.report import ReportData, Returns, render_report

    assert request.report is not None
    rate, deadline = env.unwrapped.metadata.get("render_fps"), result.get("planner", {}).get("deadline_ms")
    deadlines = {"deadline of the search": deadline, "period of control": 1000.0 / rate if rate else None}
    if request.control_hz is not None:
        deadlines["period of control"] = 1000.0 / request.control_hz
    facts = {"command": shlex.join(sys.argv), **present_facts(request.device != "cpu")}
    trained = {name: info[name] for name in ("version", "env_frames", "updates", "minutes") if name in info}
    own = {name: result[name] for name in ("seed", "renderer", "render_quality", "render_slices", "floor")}
    data = ReportData(
        task=f"{result['domain']}-{result['task']}",
        config=saved_config(request.checkpoint, info),
        returns=[Returns(request.mode, result["returns"], confidence_interval(result["returns"]))],
        film=film,
        evaluations=read_log(info),
        recording=None if recorder is None else recorder.recording,
        decision_ms=np.concatenate([episode.decision_ms for episode in episodes]),
        deadlines_ms={name: value for name, value in deadlines.items() if value is not None},
        facts={"checkpoint": str(request.checkpoint), **facts, **own, "trained": trained}
        | ({"search": result["planner"]} if "planner" in result else {}),
    )
    write_whole(request.report, render_report(data))
    print(f"report: {request.report}", flush=True)


def _describe(
    request: Request, info: dict[str, Any], env: EnvConfig, planner: PlannerConfig, goals: Goals | None
) -> dict[str, Any]:
    from latentplan.envs.registry import describe_renderer

    described = {
        "domain": env.domain if request.env else info["domain"],
        "task": env.task if request.env else info["task"],
        "mode": request.mode,
        "seed": request.seed,
        "env_frames_trained": int(info["env_frames"]),
        "render_quality": env.render_quality,
        "render_slices": env.render_slices,
        "floor": env.floor,
        "renderer": describe_renderer(env)["renderer"],
    }
    if request.mode not in planning_modes():
        return described
    is_own = goals is None or (any(phase.objective.is_return for phase in goals.phases) and not goals.constraints)
    if request.mode != "planner" or not is_own:
        planner = dataclasses.replace(planner, surprise_limit=None)  # `PlanningAgent` ignores the limit here
    return {**described, "planner": to_dict(planner)}


def _report(request: Request, result: dict[str, Any]) -> None:
    low, high = result["ci95"]
    interval = "no interval from one episode" if low is None else f"95 % interval {low:.1f} to {high:.1f}"
    latency = "   ".join(f"{name} {value:.2f}" for name, value in result["decision_ms"].items())
    print(f"mean return {result['mean_return']:.1f}  ({interval}; episodes: {result['episodes']})")
    if "objective_return" in result:
        print(f"objective return {result['objective_return']:.1f}  ({result['objective']})")
    if "violation_rate" in result:
        print(f"violation rate {result['violation_rate']:.4f}  ({result['constraint']})")
    if result.get("quantities"):  # domains without named quantities have none
        means = "   ".join(f"{name} {value:.2f}" for name, value in result["quantities"].items())
        print(f"on average   {means}")
    print(f"decision ms  {latency}", flush=True)
    surprised = result.get("surprised", 0)
    if surprised:
        decisions = sum(result["action_source"].values())
        print(f"surprised    {surprised} of {decisions} decisions are the actor's", flush=True)
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
        write_whole(request.json, json.dumps(result, indent=2) + "\n")
