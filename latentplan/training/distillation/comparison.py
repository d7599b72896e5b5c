"""What paired episodes say about two agents, in words."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from latentplan.evaluation.statistics import confidence_interval


def describe_mean(returns: Sequence[float], *, signed: bool = False) -> str:
    """Mean and 95 % interval of returns, or of differences of paired returns, which are `signed`."""
    low, high = confidence_interval(returns)
    sign = "+" if signed else ""
    if math.isnan(low):
        return f"{np.mean(returns):{sign}8.1f}"
    return f"{np.mean(returns):{sign}8.1f}  (95 % interval {low:{sign}.1f} to {high:{sign}.1f})"


@dataclass(frozen=True)
class Comparison:
    """What a distillation changed: returns on the same starts, which chose nothing.

    Attributes:
        before: Of the actor it began with.
        planner: Of the planner, whose proposals came from that actor.
        after: Of the actor chosen; None where no round was better on the starts that choose.
        planner_after: Of the planner whose proposals come from the chosen actor; None like `after`.
    """

    before: Sequence[float]
    planner: Sequence[float]
    after: Sequence[float] | None = None
    planner_after: Sequence[float] | None = None

    @property
    def is_better(self) -> bool:
        """Whether the chosen actor earns more, and more than what the planner loses by it."""
        if self.after is None or self.planner_after is None:
            return False
        gain = np.mean(self.after) - np.mean(self.before)
        return bool(gain > 0.0 and gain + np.mean(self.planner_after) - np.mean(self.planner) > 0.0)

    def describe(self, chosen_round: int) -> list[str]:
        """The lines that end a distillation, and a verdict.

        Args:
            chosen_round: Number of the round that made the chosen actor, from 1.
        """
        played = {
            "actor before": self.before,
            "actor after": self.after,
            "planner before": self.planner,
            "planner after": self.planner_after,
        }
        lines = [f"on {len(self.before)} starts that chose nothing, the same for all:"]
        lines += [f"{name:<16}{describe_mean(returns)}" for name, returns in played.items() if returns is not None]
        if self.after is None or self.planner_after is None:
            return [*lines, "no round improved on the actor it began with: that actor is kept, unchanged"]
        gains = _differences(self.after, self.before)
        differences = {
            "actor, after - before": gains,
            "planner, after - before": _differences(self.planner_after, self.planner),
            "after, actor - planner": _differences(self.after, self.planner_after),
        }
        lines += [f"{name:<24}{describe_mean(values, signed=True)}" for name, values in differences.items()]
        if np.mean(gains) <= 0.0:
            verdict = f"round {chosen_round} looked better where rounds are chosen, but not here"
            return [*lines, f"{verdict}: the actor it began with is kept, unchanged"]
        if not self.is_better:
            return [*lines, "the planner loses more than the actor gains: the actor it began with is kept, unchanged"]
        lines.append(f"kept: the actor of round {chosen_round}")
        if confidence_interval(gains)[0] <= 0.0:
            lines.append("the interval of the actor's gain holds 0: more --evaluation-episodes would tell")
        return lines


def _differences(late: Sequence[float], early: Sequence[float]) -> list[float]:
    return [one - other for one, other in zip(late, early, strict=True)]
