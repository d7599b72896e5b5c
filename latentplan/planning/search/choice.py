"""The sequence of a finished search that is executed."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from latentplan.planning.model import State
from latentplan.planning.search.elites import Scores, select_elites
from latentplan.planning.search.scorer import Scorer

Choice = tuple[Tensor, Tensor, Tensor | None]
"""Sequences (batch, horizon, action), their expected returns (batch,) and, with constraints, violations (batch,)."""


class Finalists(NamedTuple):
    """The sequences that may be executed.

    Attributes:
        mean: Mean of the final distribution, within the bounds, (batch, horizon, action).
        best: The best candidate, (batch, horizon, action).
        best_scores: Its scores, (batch, 1); a return that is not finite where there is no candidate.
        elite_return: Mean return of the last elites, (batch,).
        policy_mode: The policy's mode sequence, (batch, horizon, action); None if the policy may not replace the plan.
    """

    mean: Tensor
    best: Tensor
    best_scores: Scores
    elite_return: Tensor
    policy_mode: Tensor | None


def choose(final: str, margin: float | None, scorer: Scorer, state: State, finalists: Finalists) -> Choice:
    """Returns the sequence of a finished search that is executed, its expected return and its violation.

    Args:
        final: `mean`; `best`, the best candidate; or `better`, the mean or another sequence, by predicted return: the
            policy's mode sequence if there is one, else the best candidate.
        margin: Share of the return of the policy's mode sequence by which the return of this choice must be higher, or
            the policy's sequence takes its place; None stands for 0 with `better`, else the policy's never does.
        scorer: Scores sequences.
        state: Start of the plans, rows (batch,).
        finalists: The sequences.
    """
    mode = finalists.policy_mode  # None under constraints
    if mode is None and final == "better":
        return _choose_better(scorer, state, finalists)
    if scorer.constraints:
        return _choose_feasible(final, scorer, state, finalists)
    actions, expected = _choose_one(final, finalists)
    if margin is None and final == "better":
        margin = 0.0
    if mode is None or margin is None:
        return actions, expected, None
    return *_prefer_policy(margin, scorer, state, (actions, expected), mode), None


def _prefer_policy(
    margin: float, scorer: Scorer, state: State, choice: tuple[Tensor, Tensor], mode: Tensor
) -> tuple[Tensor, Tensor]:
    """Returns the policy's sequence where the choice does not gain the margin, else the choice.

    The expected return is that of the sequence itself, which the mean return of the elites is not.
    """
    actions, expected = choice
    is_valid = torch.isfinite(mode).flatten(1).all(1)  # a model may give an action that is NaN a finite return
    both = torch.stack([actions, torch.where(is_valid[:, None, None], mode, actions)], dim=1)
    returns, policy_returns = scorer.score(scorer.start_rows(state, 2), both).returns.unbind(1)
    is_enough = returns - policy_returns > margin * policy_returns.abs()
    is_policy = is_valid & torch.isfinite(policy_returns) & ~is_enough
    actions = torch.where(is_policy[:, None, None], mode, actions)
    expected = torch.where(torch.isfinite(returns), returns, expected)
    return actions, torch.where(is_policy, policy_returns, expected)


def _choose_one(final: str, finalists: Finalists) -> tuple[Tensor, Tensor]:
    """Returns the mean, or the best candidate where `final` is `best` and there is one."""
    best_return = finalists.best_scores.returns[:, 0]
    is_best = torch.isfinite(best_return) if final == "best" else torch.zeros_like(best_return, dtype=torch.bool)
    actions = torch.where(is_best[:, None, None], finalists.best, finalists.mean)
    return actions, torch.where(is_best, best_return, finalists.elite_return)


def _choose_better(scorer: Scorer, state: State, finalists: Finalists) -> Choice:
    """Returns the mean or the best candidate, by violation and return; the mean where neither has a finite return.

    The mean of several good sequences is another sequence, and may have a lower return than any of them.
    """
    mean = finalists.mean
    is_valid = torch.isfinite(finalists.best_scores.returns[:, 0])
    both = torch.stack([mean, torch.where(is_valid[:, None, None], finalists.best, mean)], dim=1)
    scores = scorer.score(scorer.start_rows(state, 2), both)
    better = select_elites(both, scores, num_elites=1, temperature=None)
    is_known = better.weights[:, 0] > 0
    actions = torch.where(is_known[:, None, None], better.actions[:, 0], mean)
    expected = torch.where(is_known, better.scores.returns[:, 0], finalists.elite_return)
    if scores.violations is None or better.scores.violations is None:
        return actions, expected, None
    return actions, expected, torch.where(is_known, better.scores.violations[:, 0], scores.violations[:, 0])


def _choose_feasible(final: str, scorer: Scorer, state: State, finalists: Finalists) -> Choice:
    """Returns the mean, or under constraints the best candidate where the mean violates them more."""
    scores, mean = finalists.best_scores, finalists.mean
    mean_scores = scorer.score(scorer.start_rows(state, 1), mean[:, None])
    assert mean_scores.violations is not None and scores.violations is not None
    violation, best_violation = mean_scores.violations[:, 0], scores.violations[:, 0]
    mean_return, best_return = mean_scores.returns[:, 0], scores.returns[:, 0]
    is_best = torch.isfinite(best_return)
    if final != "best":  # the mean of feasible sequences may itself be infeasible
        is_safer = best_violation < violation.nan_to_num(float("inf"))
        is_best = is_best & is_safer if scores.is_ranked else torch.zeros_like(is_best)
    mean_return = torch.where(torch.isfinite(mean_return), mean_return, finalists.elite_return)
    return (
        torch.where(is_best[:, None, None], finalists.best, mean),
        torch.where(is_best, best_return, mean_return),
        torch.where(is_best, best_violation, violation),
    )
