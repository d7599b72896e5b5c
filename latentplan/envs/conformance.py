"""Tests an environment before an agent learns in it: the contract of training, speed, seeding, rewards and pictures."""

from __future__ import annotations

import importlib
import time
import warnings
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium
import numpy as np

from latentplan.config import CollectionConfig, EnvConfig, UserError
from latentplan.config.checks import EnvironmentFault
from latentplan.config.env_id import imported_modules, is_by_id
from latentplan.envs.by_id import make_inner
from latentplan.envs.faults import FrameCheck
from latentplan.envs.process import LocalLane, ProcessLane
from latentplan.envs.rendered import time_pictures
from latentplan.envs.rewards import RewardCheck, choose_discount
from latentplan.envs.spaces import is_picture
from latentplan.envs.user import MAX_DECISIONS, describe_refusals, wrap_user_env
from latentplan.envs.vector import make_guarded_env

ENOUGH_SECONDS = 20.0  # of play, also where fewer decisions than asked for were played
FEWEST_DECISIONS = 10
STRIP_PICTURES = 8


@dataclass
class Report:
    """What a test of an environment has found.

    Attributes:
        problems: One line for each reason why training refuses the environment, with its remedy.
        notes: One line for each thing that training accepts, and that is probably not meant.
        facts: Properties of the environment, by name.
        pictures: First camera over time, uint8 (frame_size, frame_size, 3) each; empty where none could be had.
        origin: Traceback of the environment's own code at the last problem; empty without one.
    """

    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    facts: dict[str, str] = field(default_factory=dict)
    pictures: list[np.ndarray] = field(default_factory=list)
    origin: str = ""


def check_environment(
    config: EnvConfig,
    decisions: int,
    step_timeout_s: float = CollectionConfig.step_timeout_s,
    isolate: bool = True,
) -> Report:
    """Makes an environment as training does, and plays random and extreme actions.

    Args:
        config: Settings of the environment.
        decisions: Decisions to play, at least 1; fewer where the environment is slow.
        step_timeout_s: Seconds that a reset or a step may take.
        isolate: Whether the environment runs in a process of its own, so that a crash or a hang is a problem too.
    """
    report = Report()
    try:
        if is_by_id(config):
            report = _look_at_spaces(config, step_timeout_s, isolate)
            if report.problems:
                return report
        env = make_guarded_env(config, isolate=isolate, step_timeout_s=step_timeout_s)
        try:
            report.facts |= describe_spaces(env, config)
            _check_seeding(env, report)
            _play(env, config, decisions, report)
        finally:
            env.close()
    except UserError as error:
        report.problems.append(str(error))
        report.origin = error.origin if isinstance(error, EnvironmentFault) else ""
    return report


def describe_spaces(env: Any, config: EnvConfig) -> dict[str, str]:
    """The actions of an environment as agents use them, and the length of its episodes, as text by name.

    Args:
        env: The environment, from `make_env` or `make_guarded_env`.
        config: Its settings.
    """
    decisions = env.decisions_per_episode
    steps = f"at most {decisions or MAX_DECISIONS} decisions of {config.action_repeat} steps"
    return {
        "actions": f"{(env.action_space.shape or (0,))[0]} numbers in [-1, 1]",
        "episode": steps if decisions else f"no time limit; cut after {MAX_DECISIONS} decisions",
    }


def describe_space(space: gymnasium.Space[Any]) -> str:
    """A space on one line, such as `float32 (3,) in [-1, 1]`; a Dict or Tuple by its parts."""
    if isinstance(space, gymnasium.spaces.Box) and 0 not in space.shape:
        low, high = float(space.low.min()), float(space.high.max())
        bounds = f" in [{low:g}, {high:g}]" if np.isfinite([low, high]).all() else ", unbounded"
        return f"{space.dtype} {space.shape}{bounds}"
    if isinstance(space, gymnasium.spaces.Dict):
        return "Dict of " + ", ".join(f"{name} {part.shape}" for name, part in space.spaces.items())
    return str(space)


def _look_at_spaces(config: EnvConfig, step_timeout_s: float, isolate: bool) -> Report:
    """The environment's own observations and actions, and a problem for each reason why training refuses them."""
    factory = partial(_make_trial, config, imported_modules(config))
    lane = ProcessLane(factory, step_timeout_s) if isolate else LocalLane(factory)
    try:
        lane.ask("describe")
        return lane.answer()  # type: ignore[no-any-return]
    finally:
        lane.ask_to_close()
        lane.close()


def _make_trial(config: EnvConfig, modules: tuple[str, ...]) -> _Trial:
    for module in modules:
        importlib.import_module(module)
    return _Trial(config)


class _Trial(gymnasium.Env[Any, Any]):
    """An environment that nothing is known of yet, so that its spaces are looked at where it is made."""

    def __init__(self, config: EnvConfig) -> None:
        self._config, self._inner = config, make_inner(config)

    def describe(self) -> Report:
        """The spaces of the environment, whatever they are."""
        report, inner, config = Report(), self._inner, self._config
        for fact, name in (("observations", "observation_space"), ("own actions", "action_space")):
            space = getattr(inner, name, None)
            report.facts[fact] = "none" if space is None else describe_space(space)
        if config.pixels == "observation":
            report.problems += describe_refusals(inner, config)
            if _has_alpha(getattr(inner, "observation_space", None)):
                report.facts["observations"] += "; the fourth channel of a picture is read as alpha"
            return report
        report.facts["observations"] = f"pictures of render(), in place of {report.facts['observations']}"
        try:
            wrap_user_env(inner, config.action_repeat, config=config)
        except UserError as error:
            report.problems.append(str(error))
        return report

    def close(self) -> None:
        """Closes the environment."""
        self._inner.close()


def _has_alpha(space: gymnasium.Space[Any] | None) -> bool:
    """Whether a picture of an observation space has four channels along its last axis."""
    parts = space.spaces.values() if isinstance(space, gymnasium.spaces.Dict) else [space]
    return any(part is not None and is_picture(part) and (part.shape or ())[2:] == (4,) for part in parts)


def _check_seeding(env: Any, report: Report) -> None:
    first, again, other = (env.reset(seed=seed)[0] for seed in (0, 0, 1))
    if not np.array_equal(first, again):
        report.notes.append(
            "two resets with one seed give different frames, so that evaluations and resumed runs do not repeat: call "
            "super().reset(seed=seed) in reset, and draw every random number from self.np_random"
        )
    report.facts["starts"] = "differ by seed" if not np.array_equal(first, other) else "look the same for two seeds"


def _play(env: Any, config: EnvConfig, decisions: int, report: Report) -> None:
    """Plays random actions, and every tenth decision the lowest and the highest one."""
    dim = (env.action_space.shape or (0,))[0]
    generator, check = np.random.default_rng(0), FrameCheck(1)
    check_rewards = RewardCheck(1, choose_discount(env.decisions_per_episode))
    rewards: list[float] = []
    frames, lengths, terminations, env_frames = [env.reset(seed=0)[0]], [0], 0, 0
    seconds = 0.0
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for index in range(decisions):
            action = {8: -np.ones(dim), 9: np.ones(dim)}.get(index % 10, generator.uniform(-1.0, 1.0, dim))
            started = time.perf_counter()
            frame, reward, terminated, truncated, info = env.step(action.astype(np.float32))
            seconds += time.perf_counter() - started
            check(frame[None])
            check_rewards(np.array([reward], np.float64), np.array([lengths[-1] == 0]))
            frames.append(frame)
            rewards.append(reward)
            env_frames += info["env_frames"]
            lengths[-1] += 1
            terminations += terminated
            if terminated or truncated:
                frames.append(env.reset()[0])
                lengths.append(0)
            if seconds > ENOUGH_SECONDS and len(rewards) >= FEWEST_DECISIONS:
                break
    report.notes += [str(warning.message) for warning in caught if warning.category is RuntimeWarning]
    places = np.linspace(0, len(frames) - 1, min(STRIP_PICTURES, len(frames))).astype(int)
    report.pictures = [frames[place][..., :3] for place in places]
    played = len(rewards)
    report.facts |= {
        "played": f"{played} decisions, {len(lengths) - (lengths[-1] == 0)} episodes",
        "rewards": f"{min(rewards):g} to {max(rewards):g} per decision",
        "speed": f"{env_frames / seconds:.0f} steps/s, {1e3 * seconds / played:.1f} ms per decision",
    }
    if config.pixels == "render" or not is_by_id(config):
        report.facts["pictures"] = f"{time_pictures(env, config):.1f} ms per frame"
    if max(rewards) == min(rewards):
        report.notes.append(f"every reward is {rewards[0]:g}: there may be nothing to learn from so few decisions")
    if terminations:
        report.notes.append(
            "episodes end by themselves: from the first such end on plans weigh the rewards that an end costs, unless "
            "--planner.use_continues is false"
        )
