"""What paired episodes say about two agents, in words."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from latentplan.rollout import confidence_interval


def describe_mean(returns: Sequence[float], *, signed: bool = False) -> str:
    """Mean and 95 % interval of returns, or of differences of paired returns, which are `signed`."""
    low, high = confidence_interval(returns)
    sign = "+" if signed else ""
    if math.isnan(low):
        return f"{np.mean(returns):{sign}8.1f}"
    return f"{np.mean(returns):{sign}8.1f}  (95 % interval {low:{sign}.1f} to {high:{sign}.1f})"


def describe_distillation(
    before: Sequence[float], after: Sequence[float] | None, planner: Sequence[float], chosen_round: int
) -> list[str]:
    """The lines that end a distillation: actor before and after and planner on the same starts, and a verdict.

    Args:
        before: Returns of the actor it began with.
        after: Of the actor chosen, on the same starts; None where no round was better on the starts that choose.
        planner: Of the planner, on the same starts.
        chosen_round: Number of the round that made the chosen actor, from 1.
    """
    lines = [f"on {len(before)} starts that chose nothing, the same for all:", f"actor before  {describe_mean(before)}"]
    if after is not None:
        lines.append(f"actor after   {describe_mean(after)}")
    lines.append(f"planner       {describe_mean(planner)}")
    if after is None:
        return [*lines, "no round improved on the actor it began with: that actor is kept, unchanged"]
    difference = [late - early for late, early in zip(after, before, strict=True)]
    distance = [late - planned for late, planned in zip(after, planner, strict=True)]
    lines += [
        f"after - before   {describe_mean(difference, signed=True)}",
        f"after - planner  {describe_mean(distance, signed=True)}",
    ]
    if np.mean(difference) <= 0.0:
        verdict = f"round {chosen_round} looked better where rounds are chosen, but not here"
        return [*lines, f"{verdict}: the actor it began with is kept, unchanged"]
    lines.append(f"kept: the actor of round {chosen_round}")
    if confidence_interval(difference)[0] <= 0.0:
        lines.append("the interval of after - before holds 0: more --evaluation-episodes would tell")
    return lines
