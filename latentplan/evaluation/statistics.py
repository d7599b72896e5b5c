"""Statistics of a few episodes: returns, the confidence interval of their mean, and decision times."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

Floats = NDArray[np.float64]
SOURCES = ("plan", "tail", "actor")  # possible origins of an action


@dataclass(frozen=True)
class Episode:
    """The result of one episode.

    Attributes:
        total_return: Sum of the rewards.
        num_decisions: Number of actions that the agent chose.
        env_frames: Simulator control steps, counted before action repeat.
        decision_ms: Milliseconds from a frame in memory to an action, (decision,); on a virtual clock the milliseconds
            that the clock charged.
        action_source: Number of decisions by the origin of their action: "plan", "tail" or "actor".
        surprised: Number of decisions at which the actor replaced a plan because of the surprise limit.
        deadline_misses: On a virtual clock, the boundaries between periods at which the agent was still deciding.
        plan_age_ms: On a virtual clock, for each action from a plan the milliseconds from the frame that the plan began
            with until the action takes effect, (action,).
    """

    total_return: float
    num_decisions: int
    env_frames: int
    decision_ms: Floats
    action_source: dict[str, int] = field(default_factory=dict)
    surprised: int = 0
    deadline_misses: int = 0
    plan_age_ms: Floats = field(default_factory=lambda: np.zeros(0))


class EpisodeRecord:
    """Counts the rewards, frames and decisions of an episode.

    Attributes:
        total_return: Sum of the rewards so far.
        deadline_misses: See `Episode`.
        plan_age_ms: See `Episode`; a list.
    """

    def __init__(self) -> None:
        self.total_return = 0.0
        self.deadline_misses = 0
        self.plan_age_ms: list[float] = []
        self._env_frames = self._surprised = 0
        self._decision_ms: list[float] = []
        self._sources = dict.fromkeys(SOURCES, 0)

    def add_decision(self, agent: Any, decision_ms: float) -> None:
        """Counts a decision that the agent has just made, and the origin that the agent gives for its action."""
        self._decision_ms.append(decision_ms)
        source = getattr(agent, "last_source", "actor")
        self._sources[source if source in SOURCES else "actor"] += 1
        self._surprised += getattr(agent, "was_surprised", False)

    def add_step(self, reward: float, env_frames: int) -> None:
        """Counts a step of the environment."""
        self.total_return += reward
        self._env_frames += env_frames

    def episode(self) -> Episode:
        """The episode so far."""
        return Episode(
            self.total_return,
            len(self._decision_ms),
            self._env_frames,
            np.asarray(self._decision_ms),
            self._sources,
            self._surprised,
            self.deadline_misses,
            np.asarray(self.plan_age_ms),
        )


def summarize(episodes: Sequence[Episode]) -> dict[str, Any]:
    """Returns, their mean and interval, and decision times, as plain values for JSON.

    Returns:
        `episodes`, `returns`, `mean_return`, `ci95` (lower and upper end; two None for one episode), `decision_ms` with
        `p50`, `p95` and `p99`, `action_source` (number of decisions by `plan`, `tail` and `actor`) and
        `planned_fraction` (the share of `plan` and `tail` among all decisions).

    Raises:
        ValueError: `episodes` is empty.
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
    """Ends of the 95 % interval (Student's t) of the mean of independent returns; two NaN for a single return.

    Raises:
        ValueError: `returns` is empty.
    """
    if len(returns) == 0:
        raise ValueError("an interval needs at least one return, got none")
    if len(returns) == 1:
        return math.nan, math.nan
    mean, std = float(np.mean(returns)), float(np.std(returns, ddof=1))
    half = float(stdtrit(len(returns) - 1, 0.975)) * std / math.sqrt(len(returns))
    return mean - half, mean + half


def latency_percentiles(decision_ms: Floats) -> dict[str, float]:
    """Median, 95th and 99th percentile, in milliseconds, of decision times (decision,)."""
    p50, p95, p99 = np.percentile(decision_ms, [50, 95, 99])
    return {"p50": float(p50), "p95": float(p95), "p99": float(p99)}
