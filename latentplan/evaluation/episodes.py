"""Closed-loop episodes of an agent, whose starts depend on nothing but a seed and their index."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, SupportsFloat

import numpy as np
from numpy.typing import NDArray

from latentplan.config import UserError, derive_seed
from latentplan.evaluation.statistics import SOURCES, Episode, summarize

if TYPE_CHECKING:
    import gymnasium


class Agent(Protocol):
    """Whatever turns frames into actions.

    Its attribute `last_source`, where it has one, says what the most recent action came from: "plan", "tail" (of an
    older plan) or "actor". An agent that does not say so does not plan.
    """

    def act(self, frame: NDArray[np.uint8]) -> NDArray[np.float32]:
        """The action, (action,), for a frame, (height, width, channel)."""
        ...

    def reset(self) -> None:
        """Forgets the past before a new episode."""
        ...

    def seed(self, seed: int) -> None:
        """Restarts the agent's own random stream."""
        ...


@dataclass(frozen=True)
class Step:
    """One moment of an episode, seen after the agent chose and before the simulator moves.

    Attributes:
        episode: Index of the episode.
        decision: Decisions executed before this one.
        total_return: Reward earned before this decision.
        frame: What the agent sees, uint8 (height, width, channel).
        action: What it chose, (action,); None at the end of the episode, where nothing is chosen.
    """

    episode: int
    decision: int
    total_return: float
    frame: NDArray[np.uint8]
    action: NDArray[np.float32] | None


OnStep = Callable[[Step], None]


def episode_seed(seed: int, index: int) -> int:
    """The seed of episode `index`: depends on nothing else, so that agents meet the same starts."""
    return int(np.random.SeedSequence((seed, index)).generate_state(1)[0])


def evaluate_agent(
    agent: Agent, env: gymnasium.Env[Any, Any], seed: int, episodes: int, *, on_step: OnStep | None = None
) -> dict[str, Any]:
    """Plays episodes whose starts depend only on `seed` and their index.

    Returns:
        `seed`, and what `summarize` gives.

    Raises:
        ValueError: `episodes` is below 1.
    """
    seeds = [episode_seed(seed, index) for index in range(episodes)]
    return {"seed": seed, **summarize(run_episodes(env, agent, seeds, on_step=on_step))}


def run_episodes(
    env: gymnasium.Env[Any, Any], agent: Agent, seeds: Sequence[int], *, on_step: OnStep | None = None
) -> list[Episode]:
    """One episode per seed, in order, the agent in closed loop with the environment.

    Args:
        env: Environment of uint8 frames (height, width, channel); it stays open.
        agent: Reset, and its random stream restarted, before every episode.
        seeds: Seed of each episode's start, see `episode_seed`.
        on_step: Called at every decision, and once more when an episode has ended; its time is not the agent's.

    Returns:
        The episodes in the order of the seeds.
    """
    return list(iterate_episodes(env, agent, seeds, on_step=on_step))


def finite(reward: SupportsFloat) -> float:
    """The reward as a number.

    Raises:
        UserError: It is none: a mean over episodes would hide where it came from.
    """
    value = float(reward)
    if not math.isfinite(value):
        raise UserError(f"the environment gave a reward that is not finite: {value}")
    return value


def iterate_episodes(
    env: gymnasium.Env[Any, Any], agent: Agent, seeds: Sequence[int], *, on_step: OnStep | None = None
) -> Iterator[Episode]:
    """The episodes of `run_episodes`, each as soon as it has ended."""
    for index, seed in enumerate(seeds):
        yield _run_episode(env, agent, index, seed, on_step)


def _run_episode(env: gymnasium.Env[Any, Any], agent: Agent, index: int, seed: int, on_step: OnStep | None) -> Episode:
    frame, _ = env.reset(seed=seed)
    agent.reset()
    agent.seed(derive_seed(seed, "agent"))  # a stream of its own: the start must not correlate with the actions
    total_return, env_frames, over = 0.0, 0, False
    decision_ms: list[float] = []
    action_source, surprised = dict.fromkeys(SOURCES, 0), 0
    while not over:
        started = time.perf_counter()
        action = agent.act(frame)
        decision_ms.append(1000.0 * (time.perf_counter() - started))
        action_source[getattr(agent, "last_source", "actor")] += 1
        surprised += getattr(agent, "was_surprised", False)
        if on_step is not None:
            on_step(Step(index, len(decision_ms) - 1, total_return, frame, action))
        frame, reward, terminated, truncated, info = env.step(action)
        total_return += finite(reward)
        env_frames += int(info.get("env_frames", 1))
        over = terminated or truncated
    if on_step is not None:
        on_step(Step(index, len(decision_ms), total_return, frame, None))
    return Episode(total_return, len(decision_ms), env_frames, np.asarray(decision_ms), action_source, surprised)
