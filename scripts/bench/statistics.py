"""How sure a comparison of few returns can be."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from latentplan.evaluation.statistics import confidence_interval

NUM_RESAMPLES = 2000
LEAST_RESAMPLED = 5


class Estimate(NamedTuple):
    """A mean and its 95 % interval; the ends are None where there is no interval."""

    mean: float
    low: float | None
    high: float | None


def mean_estimate(returns: Sequence[float]) -> Estimate:
    """The mean of independent returns, with Student's interval."""
    low, high = confidence_interval(returns)
    mean = float(np.mean(returns))
    return Estimate(mean, None, None) if math.isnan(low) else Estimate(mean, low, high)


def paired_difference(returns: Sequence[float], reference: Sequence[float]) -> Estimate:
    """The mean of returns minus reference, episode by episode; both played the same starts in the same order.

    Raises:
        ValueError: Their numbers differ.
    """
    return mean_estimate([one - other for one, other in zip(returns, reference, strict=True)])


def interquartile_mean(values: Sequence[float]) -> float:
    """The mean of what is left when a quarter is cut off at both ends (Agarwal et al. 2021); of all below four."""
    cut = len(values) // 4
    return float(np.mean(np.sort(values)[cut : len(values) - cut]))


def interquartile_estimate(groups: Sequence[Sequence[float]], seed: int = 0) -> Estimate:
    """The interquartile mean over all groups with its 95 % interval.

    By a stratified bootstrap (Agarwal et al. 2021), but not of groups of fewer than five returns: of two it covers the
    truth half of the time. Theirs is as wide as Student's interval of the mean with a standard deviation per group.

    Args:
        groups: Returns by task, one per seed; each resample draws anew within every group.
        seed: Of the resampling.
    """
    mean = interquartile_mean(np.concatenate([np.asarray(group, float) for group in groups]).tolist())
    if any(len(group) == 1 for group in groups):  # which says nothing of how much others would differ
        return Estimate(mean, None, None)
    if min(len(group) for group in groups) < LEAST_RESAMPLED:
        half = _student_half(groups)
        return Estimate(mean, mean - half, mean + half)
    rng = np.random.default_rng(seed)
    resampled = [
        interquartile_mean(np.concatenate([rng.choice(group, len(group)) for group in groups]).tolist())
        for _ in range(NUM_RESAMPLES)
    ]
    low, high = np.percentile(resampled, [2.5, 97.5])
    return Estimate(mean, float(low), float(high))


def _student_half(groups: Sequence[Sequence[float]]) -> float:
    """Half of Student's 95 % interval for the mean of returns that fall into groups of their own spread."""
    squared = sum(len(group) * float(np.var(group, ddof=1)) for group in groups)  # of the sum
    freedom = sum(len(group) - 1 for group in groups)
    return float(stdtrit(freedom, 0.975)) * math.sqrt(squared) / sum(map(len, groups))
