"""Which sequence of a finished search is executed."""

from __future__ import annotations

import torch
from torch import Tensor

from latentplan.planning.model import State
from latentplan.planning.search.elites import select_elites
from latentplan.planning.search.progress import Progress
from latentplan.planning.search.scorer import Scorer

Choice = tuple[Tensor, Tensor, Tensor | None]
"""Sequences (batch, horizon, action), their expected returns (batch,), and, of constraints, violations (batch,)."""


def choose(
    final: str, scorer: Scorer, state: State, progress: Progress, mean: Tensor, policy_mode: Tensor | None
) -> Choice:
    """What is executed, in each environment.

    Args:
        final: `mean`; `best`, the best candidate; or `better`, the mean or the policy's mode.
        scorer: What a sequence is worth.
        state: Where the plans start, rows (batch,).
        progress: The end of the search.
        mean: Of its distribution, within the bounds, (batch, horizon, action).
        policy_mode: What the policy would do, (batch, horizon, action); None where it has no say, and `better` is
            `mean`.
    """
    assert progress.elites is not None
    if progress.elites.scores.violations is not None:
        return _choose_feasible(final, scorer, state, progress, mean)
    if final == "better" and policy_mode is not None:
        return _choose_better(scorer, state, progress, mean, policy_mode)
    if final != "best":
        return mean, progress.expected_return, None
    best_return = progress.elites.scores.returns[:, 0]
    is_best = torch.isfinite(best_return)
    actions = torch.where(is_best[:, None, None], progress.elites.actions[:, 0], mean)
    return actions, torch.where(is_best, best_return, progress.expected_return), None


def _choose_better(scorer: Scorer, state: State, progress: Progress, mean: Tensor, policy_mode: Tensor) -> Choice:
    """The mean or the policy's mode: whichever is predicted to earn more; the mean where neither is finite.

    The mean of many good sequences is none of them, and may be worth less than where it began.
    """
    is_finite = torch.isfinite(policy_mode).flatten(1).all(1)  # a model may not mind an action that is not a number
    both = torch.stack([mean, torch.where(is_finite[:, None, None], policy_mode, mean)], dim=1)
    better = select_elites(both, scorer.score(scorer.start_rows(state, 2), both), num_elites=1, temperature=None)
    is_known = better.weights[:, 0] > 0
    actions = torch.where(is_known[:, None, None], better.actions[:, 0], mean)
    return actions, torch.where(is_known, better.scores.returns[:, 0], progress.expected_return), None


def _choose_feasible(final: str, scorer: Scorer, state: State, progress: Progress, mean: Tensor) -> Choice:
    """Under constraints; the mean of feasible sequences may itself be infeasible."""
    assert progress.elites is not None
    best, scores = progress.elites.actions[:, 0], progress.elites.scores
    own = scorer.score(scorer.start_rows(state, 1), mean[:, None])
    assert own.violations is not None and scores.violations is not None
    best_return, violation, best_violation = scores.returns[:, 0], own.violations[:, 0], scores.violations[:, 0]
    is_best = torch.isfinite(best_return)
    if final != "best":
        is_safer = best_violation < violation.nan_to_num(float("inf"))
        is_best = is_best & is_safer if scores.is_ranked else torch.zeros_like(is_best)
    return (
        torch.where(is_best[:, None, None], best, mean),
        torch.where(is_best, best_return, progress.expected_return),
        torch.where(is_best, best_violation, violation),
    )
