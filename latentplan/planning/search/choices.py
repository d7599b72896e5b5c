"""Discrete dimensions of an action: the cross-entropy method with a categorical distribution (Rubinstein 1999).

The elites refit the probability of each value, as they refit mean and variance of continuous dimensions.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from numbers import Integral
from typing import Any

import torch
from einops import rearrange
from torch import Tensor

from latentplan.planning.search.elites import Elites
from latentplan.planning.search.products import contract

LEAST_PROBABILITY = 0.02  # of a value, before the sum is made 1, so that no value is excluded for ever
LEAST_TOGETHER = 0.2  # the most that the least probabilities of all values of a dimension may come to
SHARE_OF_PREVIOUS = 0.5  # probability of the previous plan's value at a warm start


class Choices:
    """The discrete dimensions of an action and their values.

    Args:
        values: By dimension, the values that an action may take there.
        dtype: Precision of actions.
        device: Device of actions.

    Attributes:
        dims: Discrete dimensions, (discrete,).
    """

    def __init__(self, values: Mapping[int, Sequence[float]], dtype: torch.dtype, device: torch.device) -> None:
        self.dims = torch.tensor(sorted(values), device=device)
        most = max(len(some) for some in values.values())
        padded = [[*values[dim], *[float("inf")] * (most - len(values[dim]))] for dim in sorted(values)]
        self._values = torch.tensor(padded, dtype=dtype, device=device)  # (discrete, value)
        self._exists = torch.isfinite(self._values)
        num_values = self._exists.sum(dim=1, keepdim=True).to(dtype)
        self._least = (LEAST_TOGETHER / num_values).clamp_max(LEAST_PROBABILITY)  # (discrete, 1)

    def start(self, mean: Tensor, is_warm: Tensor) -> Tensor:
        """Returns the probabilities at the start of a search, (batch, length, discrete, value).

        Args:
            mean: Start of the search, (batch, length, action).
            is_warm: Environments that start from a previous plan, (batch,); the others start with equal probabilities.
        """
        equal = self._exists.to(mean.dtype) / self._exists.sum(dim=1, keepdim=True)
        share = SHARE_OF_PREVIOUS * rearrange(is_warm.to(mean), "batch -> batch 1 1 1")
        return share * self._one_hot(mean) + (1 - share) * equal

    def sample(self, points: Tensor, probabilities: Tensor, noise: Tensor) -> Tensor:
        """Returns the points with sampled values in the discrete dimensions.

        Args:
            points: (batch, sample, length, action).
            probabilities: (batch, length, discrete, value).
            noise: Unit Gaussian noise, (1 or batch, sample, length, action). Its quantile chooses the value, so
                coloured noise keeps a value for several steps.
        """
        quantile = torch.special.ndtr(noise[..., self.dims])[..., None]
        index = (probabilities.cumsum(dim=-1)[:, None] < quantile).sum(dim=-1)
        index = torch.minimum(index, self._exists.sum(dim=1) - 1)
        return self._put(points, self._take(index))

    def refit(self, probabilities: Tensor, elites: Elites, smoothing: float) -> Tensor:
        """Returns the probabilities moved towards the frequencies of values among the elites; the same without elites.

        Args:
            probabilities: (batch, length, discrete, value).
            elites: Elites of the present iteration.
            smoothing: Weight of the new frequencies, in (0, 1].
        """
        frequencies = contract("be,beldv->bldv", elites.weights, self._one_hot(elites.actions))
        moved = torch.lerp(probabilities, frequencies, smoothing).clamp_min(self._least) * self._exists
        moved = moved / moved.sum(dim=-1, keepdim=True)
        has_elites = rearrange(elites.weights.sum(dim=1) > 0, "batch -> batch 1 1 1")
        return torch.where(has_elites, moved, probabilities)

    def describe(self, mean: Tensor, var: Tensor, probabilities: Tensor) -> tuple[Tensor, Tensor]:
        """Returns mean and variance, with the most probable value and the variance of values in discrete dimensions."""
        values = self._values.masked_fill(~self._exists, 0.0)
        average = (probabilities * values).sum(dim=-1)
        spread = (probabilities * values.square()).sum(dim=-1) - average.square()
        mode = self._take(probabilities.argmax(dim=-1))
        return self._put(mean, mode), self._put(var, spread.clamp_min(0.0))

    def snap(self, points: Tensor) -> Tensor:
        """Returns the points with the nearest value in each discrete dimension; NaN stays NaN."""
        given = points[..., self.dims]
        nearest = self._take(self._nearest(given))
        return self._put(points, torch.where(torch.isnan(given), given, nearest))

    def join(self, continuous: Tensor, discrete: Tensor) -> Tensor:
        """Returns the sequences `continuous`, with the discrete dimensions of the sequences `discrete`."""
        return self._put(continuous, discrete[..., self.dims])

    def _one_hot(self, points: Tensor) -> Tensor:
        index = self._nearest(points[..., self.dims])
        return torch.nn.functional.one_hot(index, self._values.shape[1]).to(points.dtype)

    def _nearest(self, given: Tensor) -> Tensor:
        distance = (given[..., None] - self._values).abs()
        return distance.nan_to_num(nan=float("inf")).argmin(dim=-1)

    def _take(self, index: Tensor) -> Tensor:
        """Returns the values of indices (..., discrete)."""
        table = self._values.expand(*index.shape, -1)
        return table.gather(-1, index[..., None])[..., 0]

    def _put(self, points: Tensor, values: Tensor) -> Tensor:
        changed = points.clone()
        changed[..., self.dims] = values
        return changed


def read_choices(given: Any, action_dim: int) -> dict[int, tuple[float, ...]]:
    """Returns the values of each discrete dimension.

    Args:
        given: None; or for every dimension, or by dimension, the number of values (0, 1, ...) or the values themselves.
        action_dim: Numbers in an action.

    Raises:
        ValueError: A dimension does not exist, or its values are not two different finite numbers or more.
    """
    if given is None:
        return {}
    by_dimension = given if isinstance(given, Mapping) else dict.fromkeys(range(action_dim), given)
    choices: dict[int, tuple[float, ...]] = {}
    for dim, some in by_dimension.items():
        if isinstance(dim, bool) or not isinstance(dim, Integral) or not 0 <= int(dim) < action_dim:
            raise ValueError(f"action_choices names dimension {dim!r}; dimensions are 0 to {action_dim - 1}")
        try:
            values = tuple(map(float, range(int(some)) if isinstance(some, Integral) else some))
        except (TypeError, ValueError):
            hint = "the number of values, a whole number, or the values themselves"
            raise ValueError(f"action_choices takes {hint}, got {some!r} for {dim}") from None
        is_finite = all(map(math.isfinite, values))
        if len(set(values)) < 2 or len(set(values)) != len(values) or not is_finite:
            raise ValueError(f"action_choices needs two different finite values or more, got {some!r} for {dim}")
        choices[int(dim)] = values
    return choices
