"""The equations of the cross-entropy method: selecting elites, and refitting the distribution to them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple

import torch
from torch import Tensor


class Scores(NamedTuple):
    """Returns and constraint violations of candidates.

    Attributes:
        returns: Returns, (batch, sample); larger is better.
        violations: Constraint violations, 0 where all constraints are satisfied, (batch, sample); None without
            constraints.
        is_ranked: Whether candidates are ranked by violation first and by return second.
    """

    returns: Tensor
    violations: Tensor | None = None
    is_ranked: bool = True

    @property
    def is_finite(self) -> Tensor:
        """Whether return and violation are finite, (batch, sample) bool; other candidates are never elites."""
        is_finite = torch.isfinite(self.returns)
        return is_finite if self.violations is None else is_finite & torch.isfinite(self.violations)

    def first(self, num: int) -> Scores:
        """Returns the scores of the first `num` candidates."""
        return self._part(slice(num))

    def rest(self, num: int) -> Scores:
        """Returns the scores of all but the first `num` candidates."""
        return self._part(slice(num, None))

    def _part(self, samples: slice) -> Scores:
        violations = None if self.violations is None else self.violations[:, samples]
        return Scores(self.returns[:, samples], violations, self.is_ranked)

    @staticmethod
    def join(parts: Sequence[Scores]) -> Scores:
        """Returns the scores of several groups of candidates, concatenated."""
        violations = [part.violations for part in parts if part.violations is not None]
        joined = torch.cat(violations, dim=1) if violations else None
        return Scores(torch.cat([part.returns for part in parts], dim=1), joined, parts[0].is_ranked)


class Elites(NamedTuple):
    """The best candidates of one iteration, best first.

    Attributes:
        actions: Sequences, (batch, elite, horizon, action).
        scores: Their scores, (batch, elite).
        weights: Weights in the new mean, (batch, elite); their sum is 1, or 0 where no candidate has a finite return.
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
    """Returns mean and variance after one step of the cross-entropy method.

    Mean and population variance (1/K) of the elites are blended with the old ones: `smoothing * elite + (1 - smoothing)
    * old`. A candidate whose return is NaN or infinite is never an elite. If fewer than `num_elites` candidates have a
    finite return, only these candidates are elites. Without any, mean and variance stay.

    Args:
        candidates: Action sequences, (sample, horizon, action) or (batch, sample, horizon, action).
        returns: Their returns, maximised, (sample,) or (batch, sample).
        mean: Mean of the distribution of the candidates, (horizon, action) or (batch, horizon, action).
        var: Variance of this distribution, shaped like `mean`.
        num_elites: Number of elites.
        smoothing: Weight of the new statistics, in (0, 1].
        temperature: Elites are weighted by exp(return / (temperature * spread)) as in MPPI, where the spread is the
            standard deviation of their returns; None weights all alike.

    Returns:
        New mean and variance, shaped like `mean`.

    Raises:
        ValueError: Shapes do not fit each other, there are fewer candidates than elites, or a number is out of range.
    """
    candidates, returns, mean, var = _same_precision(candidates, returns, mean, var)
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
    """Returns the best candidates: by return, or by violation first and by return second if `scores.is_ranked`.

    Args:
        candidates: (batch, sample, horizon, action).
        scores: Their scores, (batch, sample).
        num_elites: Number of elites.
        temperature: See `refit`.
    """
    returns, violations, is_ranked = scores
    is_finite = scores.is_finite
    if violations is not None:
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
        exponents = best if violation is None or not is_ranked else _weight_exponents(best, violation)
        # A softmax over nothing would be NaN. Below the best, exponents stay finite where all returns are equal.
        exponents = torch.where(is_valid[:, :1], exponents - exponents[:, :1], 0.0)
        weights = weights * torch.softmax(exponents / _spread(exponents) / temperature, dim=1)
    weights = weights / weights.sum(dim=1, keepdim=True).clamp_min(torch.finfo(weights.dtype).tiny)
    chosen = torch.take_along_dim(candidates, index[:, :, None, None], dim=1)
    # A NaN action would make the weighted mean NaN, even with weight 0.
    chosen = torch.where(is_valid[:, :, None, None], chosen, 0.0)
    return Elites(chosen, Scores(best, violation, is_ranked), weights)


def move_towards(
    elites: Elites, mean: Tensor, var: Tensor, *, smoothing: float, adapt_std: bool = True
) -> tuple[Tensor, Tensor]:
    """Returns mean and variance, (batch, horizon, action), moved towards the elites'; unchanged without elites.

    Args:
        elites: Elites of the present iteration.
        mean: Mean of the search distribution, (batch, horizon, action).
        var: Variance of the search distribution, (batch, horizon, action).
        smoothing: Weight of the elites' statistics, in (0, 1].
        adapt_std: Whether the variance moves too.
    """
    weights = elites.weights[:, :, None, None]  # (batch, elite, 1, 1)
    has_elites = elites.weights.sum(dim=1)[:, None, None] > 0
    elite_mean = (weights * elites.actions).sum(dim=1)
    new_mean = torch.where(has_elites, torch.lerp(mean, elite_mean, smoothing), mean)
    if not adapt_std:
        return new_mean, var
    elite_var = (weights * (elites.actions - elite_mean[:, None]).square()).sum(dim=1)
    return new_mean, torch.where(has_elites, torch.lerp(var, elite_var, smoothing), var)


def mean_return(elites: Elites) -> Tensor:
    """Returns the weighted mean return of the elites, NaN without elites, (batch,)."""
    total = (elites.weights * elites.scores.returns.masked_fill(elites.weights == 0, 0.0)).sum(dim=1)
    return total.masked_fill(elites.weights.sum(dim=1) == 0, float("nan"))


def spread_of_returns(elites: Elites) -> Tensor:
    """Returns the standard deviation of the elites' returns, above 0, (batch,)."""
    returns = elites.scores.returns.masked_fill(elites.weights == 0, float("-inf"))
    return _spread(returns)[:, 0]


def _same_precision(*tensors: Tensor) -> list[Tensor]:
    """Returns the tensors in one floating-point precision that holds them all."""
    dtype = reduce(torch.promote_types, (tensor.dtype for tensor in tensors))
    dtype = dtype if dtype.is_floating_point else torch.float32
    return [tensor.to(dtype) for tensor in tensors]


def _feasible_first(returns: Tensor, violations: Tensor) -> Tensor:
    """Returns the order of candidates by violation, and among equal violations by return, (batch, sample)."""
    by_return = torch.argsort(returns, dim=1, descending=True, stable=True)
    by_violation = torch.argsort(violations.gather(1, by_return), dim=1, stable=True)
    return by_return.gather(1, by_violation)


def _spread(exponents: Tensor) -> Tensor:
    """Returns the standard deviation of the finite exponents of each environment, above 0, (batch, 1)."""
    is_finite = torch.isfinite(exponents)
    num = is_finite.sum(dim=1, keepdim=True).clamp_min(1)
    known = exponents.masked_fill(~is_finite, 0.0)
    tiny = torch.finfo(exponents.dtype).tiny
    largest = known.abs().amax(dim=1, keepdim=True).clamp_min(tiny)
    known = known / largest  # whose squares cannot overflow
    mean = known.sum(dim=1, keepdim=True) / num
    var = (known - mean).masked_fill(~is_finite, 0.0).square().sum(dim=1, keepdim=True) / num
    return (var.sqrt() * largest).clamp_min(tiny)


def _weight_exponents(returns: Tensor, violations: Tensor) -> Tensor:
    """Returns the exponents of the weights of ranked elites: the returns of feasible ones, else minus violations."""
    has_feasible = violations[:, :1] == 0
    return torch.where(has_feasible, returns.masked_fill(violations > 0, float("-inf")), -violations)
