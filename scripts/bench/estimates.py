"""Means of a few returns with their 95 % confidence intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from latentplan.evaluation.statistics import confidence_interval

NUM_RESAMPLES = 2000
MIN_RESAMPLED = 5


class Estimate(NamedTuple):
    """A mean and its 95 % interval; the ends are None without an interval."""

    mean: float
    low: float | None
    high: float | None


def mean_estimate(returns: Sequence[float]) -> Estimate:
    """The mean of independent returns, with Student's interval."""
    low, high = confidence_interval(returns)
    mean = float(np.mean(returns))
    return Estimate(mean, None, None) if math.isnan(low) else Estimate(mean, low, high)


def paired_difference(returns: Sequence[float], reference: Sequence[float]) -> Estimate:
    """The mean of returns minus reference, episode by episode; episode i of both has the same start.

    Raises:
        ValueError: The numbers of episodes differ.
    """
    return mean_estimate([one - other for one, other in zip(returns, reference, strict=True)])


def interquartile_mean(values: Sequence[float]) -> float:
    """The mean without the lowest and the highest quarter of the values (Agarwal et al. 2021); of all below four."""
    return float(_trimmed_mean(np.asarray(values, float)))


def interquartile_estimate(groups: Sequence[Sequence[float]]) -> Estimate:
    """The interquartile mean over all groups with its 95 % interval.

    The interval is a stratified bootstrap (Agarwal et al. 2021) for groups of at least five returns. A bootstrap of two
    returns covers the truth half of the time, so smaller groups get Student's interval of the mean, with a standard
    deviation per group.

    Args:
        groups: Returns by task, one per seed; each resample draws anew within every group.
    """
    mean = interquartile_mean([value for group in groups for value in group])
    if any(len(group) == 1 for group in groups):  # one return has no spread
        return Estimate(mean, None, None)
    if min(len(group) for group in groups) < MIN_RESAMPLED:
        half = _student_half_width(groups)
        return Estimate(mean, mean - half, mean + half)
    from scipy.stats import bootstrap

    def statistic(*resampled: NDArray[np.float64], axis: int = -1) -> NDArray[np.float64]:
        return _trimmed_mean(np.concatenate(resampled, axis), axis)

    rng = np.random.default_rng(0)
    samples = [np.asarray(group, float) for group in groups]
    options = {"n_resamples": NUM_RESAMPLES, "method": "percentile", "vectorized": True, "random_state": rng}
    low, high = bootstrap(samples, statistic, **options).confidence_interval
    return Estimate(mean, float(low), float(high))


def _trimmed_mean(values: NDArray[np.float64], axis: int = -1) -> NDArray[np.float64]:
    from scipy.stats import trim_mean  # scipy.stats takes a second to import

    trimmed: NDArray[np.float64] = trim_mean(values, 0.25, axis)
    return trimmed


def _student_half_width(groups: Sequence[Sequence[float]]) -> float:
    """Half the width of Student's 95 % interval for the mean of groups that each have their own spread."""
    variance_of_sum = sum(len(group) * float(np.var(group, ddof=1)) for group in groups)
    freedom = sum(len(group) - 1 for group in groups)
    return float(stdtrit(freedom, 0.975)) * math.sqrt(variance_of_sum) / sum(map(len, groups))
