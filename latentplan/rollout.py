"""Closed-loop episodes and their statistics.

Everything here is about what an agent earns in the simulator: episodes whose start depends on nothing but a seed and
their index, how long the agent thought about each action, and how sure a mean of so few returns can be.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol, SupportsFloat

import numpy as np
from numpy.typing import NDArray

from latentplan.config import UserError, derive_seed

if TYPE_CHECKING:
    import gymnasium

Floats = NDArray[np.float64]

# Two-sided 95 % quantiles of Student's t for 1 to 10 degrees of freedom.
_T_QUANTILES = (12.7062, 4.3027, 3.1824, 2.7764, 2.5706, 2.4469, 2.3646, 2.3060, 2.2622, 2.2281)


SOURCES = ("plan", "tail", "actor")


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


@dataclass(frozen=True)
class Episode:
    """What one episode came to.

    Attributes:
        total_return: Sum of the rewards.
        num_decisions: Actions chosen.
        env_frames: Simulator control steps, counted before action repeat.
        decision_ms: Milliseconds from a frame in memory to an action, (decision,).
        action_source: Decisions by what their action came from: "plan", "tail" or "actor".
        surprised: Those of "actor" where there was a plan that a surprising frame discredited.
    """

    total_return: float
    num_decisions: int
    env_frames: int
    decision_ms: Floats
    action_source: dict[str, int] = field(default_factory=dict)
    surprised: int = 0


OnStep = Callable[[Step], None]


def episode_seed(seed: int, index: int) -> int:
    """The seed of episode `index`: depends on nothing else, so that agents meet the same starts."""
    return int(np.random.SeedSequence((seed, index)).generate_state(1)[0])


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


def summarize(episodes: Sequence[Episode]) -> dict[str, Any]:
    """Returns, their mean and interval, and decision latency, as plain values for JSON.

    Returns:
        `episodes`, `returns`, `mean_return`, `ci95` (a pair; of None where one episode gives no interval),
        `decision_ms` with `p50`, `p95` and `p99`, `action_source` (decisions by `plan`, `tail` and `actor`) and
        `planned_fraction` (the share of `plan` and `tail` among them).

    Raises:
        ValueError: There is no episode.
    """
    returns = [episode.total_return for episode in episodes]
    low, high = confidence_interval(returns)
    sources = {name: sum(episode.action_source.get(name, 0) for episode in episodes) for name in SOURCES}
    return {
        "episodes": len(returns),
        "returns": returns,
        "mean_return": float(np.mean(returns)),
        "ci95": [None, None] if math.isnan(low) else [low, high],
        "decision_ms": latency_percentiles(np.concatenate([episode.decision_ms for episode in episodes])),
        "planned_fraction": (sources["plan"] + sources["tail"]) / max(1, sum(sources.values())),
        "action_source": sources,
    }


def confidence_interval(returns: Sequence[float]) -> tuple[float, float]:
    """The 95 % interval (Student's t) of the mean of independent returns; NaN for a single one.

    Raises:
        ValueError: There is no return.
    """
    if len(returns) == 0:
        raise ValueError("an interval needs at least one return, got none")
    if len(returns) == 1:
        return math.nan, math.nan
    mean, std = float(np.mean(returns)), float(np.std(returns, ddof=1))
    half = t_quantile(len(returns) - 1) * std / math.sqrt(len(returns))
    return mean - half, mean + half


def latency_percentiles(decision_ms: Floats) -> dict[str, float]:
    """Median, 95th and 99th percentile, in milliseconds, of decision times (decision,)."""
    p50, p95, p99 = np.percentile(decision_ms, [50, 95, 99])
    return {"p50": float(p50), "p95": float(p95), "p99": float(p99)}


def t_quantile(freedom: int) -> float:
    """The 0.975 quantile of Student's t; above 10 degrees of freedom by its series (Abramowitz and Stegun 26.7.5)."""
    if freedom <= len(_T_QUANTILES):
        return _T_QUANTILES[freedom - 1]
    z = 1.959964
    first = (z**3 + z) / 4
    second = (5 * z**5 + 16 * z**3 + 3 * z) / 96
    third = (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384
    return z + first / freedom + second / freedom**2 + third / freedom**3
