"""What a few episodes say of an agent: returns, how sure their mean is, and decision latency."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

Floats = NDArray[np.float64]
SOURCES = ("plan", "tail", "actor")  # where an action can come from


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
    half = float(stdtrit(len(returns) - 1, 0.975)) * std / math.sqrt(len(returns))
    return mean - half, mean + half


def latency_percentiles(decision_ms: Floats) -> dict[str, float]:
    """Median, 95th and 99th percentile, in milliseconds, of decision times (decision,)."""
    p50, p95, p99 = np.percentile(decision_ms, [50, 95, 99])
    return {"p50": float(p50), "p95": float(p95), "p99": float(p99)}
