"""Closed-loop episodes of an agent, whose starts depend only on a seed and the index of the episode."""

from __future__ import annotations

import math
import operator
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, SupportsFloat

import numpy as np
from numpy.typing import NDArray

from latentplan.agents.base import Agent, Seen
from latentplan.config import UserError, derive_seed
from latentplan.config.checks import shown
from latentplan.evaluation.statistics import Episode, EpisodeRecord, summarize

if TYPE_CHECKING:
    import gymnasium

Frame = NDArray[np.uint8]
Action = NDArray[np.float32]
Outcome = tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]  # result of `step` of a gymnasium environment


@dataclass(frozen=True)
class Step:
    """One moment of an episode, after the agent chose an action and before the simulator moves.

    Attributes:
        episode: Index of the episode.
        decision: Decisions executed before this one.
        total_return: Reward earned before this decision.
        frame: The frame that the agent sees, uint8 (height, width, channel).
        action: The chosen action, (action,); None at the end of the episode, where no action is chosen.
    """

    episode: int
    decision: int
    total_return: float
    frame: Frame
    action: Action | None


OnStep = Callable[[Step], None]


def episode_seed(seed: int, index: int) -> int:
    """The seed of an episode, in [0, 2**32), which is the same for every agent.

    Args:
        seed: Seed of the evaluation, at least 0.
        index: Index of the episode, from 0.
    """
    return int(np.random.SeedSequence((seed, index)).generate_state(1)[0])


def evaluate_agent(
    agent: Agent, env: gymnasium.Env[Any, Any], seed: int, episodes: int, *, on_step: OnStep | None = None
) -> dict[str, Any]:
    """Returns and decision times of an agent over whole episodes, as plain values for JSON.

    Episode i starts from a state that depends only on `seed` and i, so that all agents have the same starts. The agent
    is reset, and its random stream restarted, before every episode.

    Args:
        agent: Any object with `act(frame)`, `reset()` and `seed(seed)`, such as the result of `latentplan.load_agent`.
        env: One gymnasium environment with the agent's observations and actions: for a trained agent, frames uint8
            (64, 64, 3) and actions (action,) in [-1, 1], as from `latentplan.envs.make_env` and
            `latentplan.envs.wrap_user_env`. The environment stays open.
        seed: Seed of the evaluation, at least 0.
        episodes: Number of episodes, at least 1. An episode lasts until the environment terminates or truncates it.
        on_step: Called with a `Step` at every decision, and once more when an episode has ended; the time of the call
            is not counted as decision time.

    Returns:
        A dictionary with:
            `seed`: As given.
            `episodes`: Number of episodes.
            `returns`: Sum of the rewards of each episode, in order.
            `mean_return`: Mean of the returns.
            `ci95`: Lower and upper end of the 95 % interval of the mean (Student's t); two None for one episode.
            `decision_ms`: Milliseconds per decision: `p50`, `p95` and `p99`.
            `action_source`: Number of decisions whose action came from a `plan`, the `tail` of an older plan, or the
                `actor`.
            `planned_fraction`: Share of `plan` and `tail` among all decisions, in [0, 1].

    Raises:
        ValueError: `episodes` is below 1, `seed` is below 0, or the agent refuses the environment's frames.
        TypeError: `seed` is no whole number.
        UserError: The environment gave a reward that is not a finite number, or is a vector environment.
    """
    if hasattr(env, "single_observation_space"):
        raise UserError("evaluate_agent plays one environment, not a vector environment: make it with gymnasium.make")
    seed = operator.index(seed)
    seeds = [episode_seed(seed, index) for index in range(episodes)]
    return {"seed": seed, **summarize(run_episodes(env, agent, seeds, on_step=on_step))}


def run_episodes(
    env: gymnasium.Env[Any, Any], agent: Agent, seeds: Sequence[int], *, on_step: OnStep | None = None
) -> list[Episode]:
    """Plays one episode per seed, in order, with the agent in closed loop.

    Args:
        env: Environment of uint8 frames (height, width, channel); it stays open.
        agent: Reset, and its random stream restarted, before every episode.
        seeds: Seed of each episode's start, see `episode_seed`.
        on_step: See `evaluate_agent`.

    Returns:
        The episodes in the order of the seeds.

    Raises:
        UserError: The environment gave a reward that is not finite.
    """
    return list(iterate_episodes(env, agent, seeds, on_step=on_step))


def iterate_episodes(
    env: gymnasium.Env[Any, Any], agent: Agent, seeds: Sequence[int], *, on_step: OnStep | None = None
) -> Iterator[Episode]:
    """The episodes of `run_episodes`, each as soon as it has ended."""
    for index, seed in enumerate(seeds):
        yield play_episode(env, agent, index, seed, WaitingWorld(env), on_step)


class World(Protocol):
    """The order in which an environment and an agent act during one episode.

    Attributes:
        record: Counts the rewards, frames and decisions of the episode.
    """

    record: EpisodeRecord

    def begin(self, seed: int) -> None:
        """Prepares an episode; called after the reset of environment and agent."""
        ...

    def decide(self, agent: Agent, frame: Seen) -> Action:
        """The agent's latest action, (action,): for this frame, or for an earlier frame while the agent is busy."""
        ...

    def step(self) -> Outcome:
        """Moves the environment for one decision."""
        ...


class WaitingWorld:
    """A world that stands still while the agent decides.

    Args:
        env: The environment.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        self.env, self.record = env, EpisodeRecord()

    def begin(self, seed: int) -> None:
        """Does nothing: no time passes in this world."""

    def decide(self, agent: Agent, frame: Seen) -> Action:
        """The action that the agent chooses for a frame; its decision time is recorded."""
        started = time.perf_counter()
        self._action = agent.act(frame)
        self.record.add_decision(agent, 1000.0 * (time.perf_counter() - started))
        return self._action

    def step(self) -> Outcome:
        """Executes the action."""
        return self.env.step(self._action)


def play_episode(env: Any, agent: Agent, index: int, seed: int, world: World, on_step: OnStep | None) -> Episode:
    """Plays one episode, from the reset of environment and agent to the end.

    Args:
        env: Environment of uint8 frames (height, width, channel).
        agent: The agent.
        index: Index of the episode, for `on_step`.
        seed: Seed of the episode's start, see `episode_seed`.
        world: The world of this episode; a new one for every episode.
        on_step: See `run_episodes`.

    Raises:
        UserError: The environment gave a reward that is not finite.
    """
    frame, info = env.reset(seed=seed)
    agent.reset()
    agent.seed(derive_seed(seed, "agent"))  # independent of the stream of the start
    world.begin(seed)
    record, decision, is_over = world.record, 0, False
    while not is_over:
        action = world.decide(agent, see(frame, info))
        if on_step is not None:
            on_step(Step(index, decision, record.total_return, frame, action))
        frame, reward, terminated, truncated, info = world.step()
        record.add_step(_check_reward(reward), int(info.get("env_frames", 1)))
        decision += 1
        is_over = terminated or truncated
    if on_step is not None:
        on_step(Step(index, decision, record.total_return, frame, None))
    return record.episode()


def see(frame: Frame, info: dict[str, Any]) -> Seen:
    """What an agent sees: the frame, and the numbers beside it where the environment reports some."""
    return (frame, info["vectors"]) if "vectors" in info else frame


def _check_reward(reward: SupportsFloat) -> float:
    """The reward as a number; refused if it is not finite, because a mean over episodes would hide the episode."""
    try:
        value = float(reward)
    except (TypeError, ValueError):
        raise UserError(f"the environment gave a reward that is no number: {shown(reward)}") from None
    if not math.isfinite(value):
        raise UserError(f"the environment gave a reward that is not finite: {value}")
    return value
