"""The equations of the cross-entropy method: who the elites are, and what distribution they suggest."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple

import torch
from einops import rearrange
from torch import Tensor


class Scores(NamedTuple):
    """How good candidates are.

    Attributes:
        returns: Maximised, (batch, sample).
        violations: How far each breaks the constraints, 0 where it keeps them, (batch, sample); None without any.
        is_ranked: Whether violations decide before returns do.
    """

    returns: Tensor
    violations: Tensor | None = None
    is_ranked: bool = True

    def first(self, num: int) -> Scores:
        """The scores of the first candidates."""
        return self._part(slice(num))

    def rest(self, num: int) -> Scores:
        """The scores of all but the first candidates."""
        return self._part(slice(num, None))

    def _part(self, samples: slice) -> Scores:
        violations = None if self.violations is None else self.violations[:, samples]
        return Scores(self.returns[:, samples], violations, self.is_ranked)

    @staticmethod
    def join(parts: Sequence[Scores]) -> Scores:
        """The scores of several groups of candidates, one after the other."""
        violations = [part.violations for part in parts if part.violations is not None]
        joined = torch.cat(violations, dim=1) if violations else None
        return Scores(torch.cat([part.returns for part in parts], dim=1), joined, parts[0].is_ranked)


class Elites(NamedTuple):
    """The best candidates of one iteration, best first.

    Attributes:
        actions: Sequences, (batch, elite, horizon, action).
        scores: How good they are, (batch, elite).
        weights: Their share in the new mean, summing to 1, or to 0 where no candidate was finite, (batch, elite).
    """

    actions: Tensor
    scores: Scores
    weights: Tensor


def refit(
    candidates: Tensor,
    returns: Tensor,
    mean: Tensor,
    var: Tensor,
    *,
    num_elites: int,
    smoothing: float,
    temperature: float | None = None,
) -> tuple[Tensor, Tensor]:
    """One step of the cross-entropy method: the Gaussian moves towards its best candidates.

    Elite mean and population variance (1/K) are blended with the old ones: `smoothing * elite + (1 - smoothing) * old`,
    for the mean and for the variance. A candidate whose return is NaN or infinite is never an elite; where fewer than
    `num_elites` are finite those few are used, and where none is the distribution stays.

    Args:
        candidates: Action sequences, (sample, horizon, action) or (batch, sample, horizon, action).
        returns: Their returns, maximised, (sample,) or (batch, sample).
        mean: Mean that the candidates were drawn around, (horizon, action) or (batch, horizon, action).
        var: Variance that they were drawn with, shaped like `mean`.
        num_elites: How many candidates count.
        smoothing: Weight of the new statistics, in (0, 1].
        temperature: None weighs elites alike; a number by exp(return / temperature), as MPPI does.

    Returns:
        New mean and variance, shaped like the old.

    Raises:
        ValueError: Shapes do not belong together, there are fewer candidates than elites, or a number is out of range.
    """
    candidates, returns, mean, var = _alike(candidates, returns, mean, var)
    if candidates.ndim == 3:
        batched = (candidates[None], returns[None], mean[None], var[None])
        new_mean, new_var = refit(*batched, num_elites=num_elites, smoothing=smoothing, temperature=temperature)
        return new_mean[0], new_var[0]
    batch, num_samples, horizon, action_dim = candidates.shape
    if returns.shape != (batch, num_samples) or mean.shape != (batch, horizon, action_dim) or var.shape != mean.shape:
        raise ValueError(
            f"candidates {tuple(candidates.shape)} do not fit returns {tuple(returns.shape)}, "
            f"mean {tuple(mean.shape)} and var {tuple(var.shape)}"
        )
    if not 1 <= num_elites <= num_samples:
        raise ValueError(f"num_elites ({num_elites}) must lie in 1 to the number of candidates ({num_samples})")
    if not 0.0 < smoothing <= 1.0 or not (temperature is None or temperature > 0.0):
        raise ValueError(f"smoothing must lie in (0, 1] and temperature above 0, got {smoothing} and {temperature}")
    elites = select_elites(candidates, Scores(returns), num_elites=num_elites, temperature=temperature)
    return move_towards(elites, mean, var, smoothing=smoothing)


def select_elites(candidates: Tensor, scores: Scores, *, num_elites: int, temperature: float | None) -> Elites:
    """The best candidates: by return, or, where violations rank, the feasible first and then the least infeasible.

    Args:
        candidates: (batch, sample, horizon, action).
        scores: How good each is, (batch, sample).
        num_elites: How many to take.
        temperature: See `refit`.
    """
    returns, violations, is_ranked = scores
    is_finite = torch.isfinite(returns)
    if violations is not None:
        is_finite = is_finite & torch.isfinite(violations)
        violations = violations.masked_fill(~is_finite, float("inf"))
    returns = returns.masked_fill(~is_finite, float("-inf"))
    if violations is None or not is_ranked:
        best, index = torch.topk(returns, num_elites, dim=1)
    else:
        index = _feasible_first(returns, violations)[:, :num_elites]
        best = returns.gather(1, index)
    is_valid = torch.isfinite(best)
    violation = None if violations is None else violations.gather(1, index)
    weights = is_valid.to(candidates.dtype)
    if temperature is not None:
        merit = best if violation is None or not is_ranked else _merit(best, violation)
        merit = torch.where(is_valid[:, :1], merit, 0.0)  # a softmax over nothing would be NaN
        weights = weights * torch.softmax(merit / temperature, dim=1)
    weights = weights / weights.sum(dim=1, keepdim=True).clamp_min(torch.finfo(weights.dtype).tiny)
    chosen = torch.take_along_dim(candidates, index[:, :, None, None], dim=1)
    # Weight 0 does not silence an action that is itself NaN.
    chosen = torch.where(is_valid[:, :, None, None], chosen, 0.0)
    return Elites(chosen, Scores(best, violation, is_ranked), weights)


def move_towards(
    elites: Elites, mean: Tensor, var: Tensor, *, smoothing: float, adapt_std: bool = True
) -> tuple[Tensor, Tensor]:
    """Mean and variance, (batch, horizon, action), moved towards those of the elites; unmoved where there are none."""
    weights = rearrange(elites.weights, "batch elite -> batch elite 1 1")
    found = elites.weights.sum(dim=1)[:, None, None] > 0
    elite_mean = (weights * elites.actions).sum(dim=1)
    new_mean = torch.where(found, torch.lerp(mean, elite_mean, smoothing), mean)
    if not adapt_std:
        return new_mean, var
    elite_var = (weights * (elites.actions - elite_mean[:, None]).square()).sum(dim=1)
    return new_mean, torch.where(found, torch.lerp(var, elite_var, smoothing), var)


def mean_return(elites: Elites) -> Tensor:
    """Weighted mean return of the elites, NaN where there are none, (batch,)."""
    total = (elites.weights * elites.scores.returns.masked_fill(elites.weights == 0, 0.0)).sum(dim=1)
    return total.masked_fill(elites.weights.sum(dim=1) == 0, float("nan"))


def _alike(*tensors: Tensor) -> list[Tensor]:
    """The tensors in one floating-point precision that holds them all."""
    dtype = reduce(torch.promote_types, (tensor.dtype for tensor in tensors))
    dtype = dtype if dtype.is_floating_point else torch.float32
    return [tensor.to(dtype) for tensor in tensors]


def _feasible_first(returns: Tensor, violations: Tensor) -> Tensor:
    """Order of candidates by violation, and among equals (all feasible ones are) by return, (batch, sample)."""
    by_return = torch.argsort(returns, dim=1, descending=True, stable=True)
    by_violation = torch.argsort(violations.gather(1, by_return), dim=1, stable=True)
    return by_return.gather(1, by_violation)


def _merit(returns: Tensor, violations: Tensor) -> Tensor:
    """What weighs elites that are in feasible-first order: return among the feasible, without those the violation."""
    has_feasible = violations[:, :1] == 0
    return torch.where(has_feasible, returns.masked_fill(violations > 0, float("-inf")), -violations)
