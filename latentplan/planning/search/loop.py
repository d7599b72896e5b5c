"""One search, from the first candidates to the plan: the loop that CEM, iCEM and MPPI run.

`Search.run` makes a plan in these steps:

1.  shift the previous plan to the present; its actions are the start of the search distribution;
2.  let the model's policy propose action sequences;
3.  repeat: sample candidates from the distribution, score them in the model, select the elites, and move mean and
    variance towards the elites;
4.  choose the sequence to execute: the mean, the best candidate, or the better of the mean and the policy's sequence;
5.  if asked, refine this sequence by gradient ascent.

A search with a deadline skips the parts that would end too late (`deadline`). Scores come from `scorer`, and the
equations of step 3 from `elites`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils._pytree import tree_map

from latentplan.config.planner import SearchOptions
from latentplan.planning.model import Model, State, action_dtype, count_rows, state_device, supports
from latentplan.planning.objectives import Constraint, Term, apply_view
from latentplan.planning.plan import Plan, WarmStart, shift_plan
from latentplan.planning.search.deadline import Budget, Pace
from latentplan.planning.search.elites import Elites, Scores, mean_return, move_towards, select_elites
from latentplan.planning.search.gradient import ascend
from latentplan.planning.search.sampling import Generators, Streams
from latentplan.planning.search.scorer import Scorer

Candidates = tuple[Tensor, Scores]
"""Sequences (batch, sample, horizon, action) and their scores."""

Choice = tuple[Tensor, Tensor, Tensor | None]
"""Sequences (batch, horizon, action), their expected returns (batch,) and, with constraints, violations (batch,)."""


@dataclass(frozen=True)
class Problem:
    """The problem that one search solves.

    Attributes:
        model: The model in which action sequences are imagined.
        state: Start of the plans, rows (batch,).
        objective: Maximised; None is the predicted return.
        constraints: Violations that candidates must avoid.
        low: Lowest action, (action,).
        high: Highest action, (action,).
        init_std: Standard deviation at the start of the search, (action,); None takes a quarter of the action range.
        discount: Discount per model step, in (0, 1].
    """

    model: Model
    state: State
    objective: Term | None
    constraints: Sequence[Constraint]
    low: Tensor
    high: Tensor
    init_std: Tensor | None
    discount: float


class Progress(NamedTuple):
    """The state of a search between two refits. Dim 0 of every tensor is the environment, and a finished one is frozen.

    Attributes:
        mean: Mean of the search distribution, (batch, horizon, action).
        var: Variance of the search distribution, (batch, horizon, action).
        elites: Elites of the last refit; None before the first.
        expected_return: Mean return of the last elites, NaN before the first refit, (batch,).
        num_nonfinite: Number of candidates so far whose return was not finite, (batch,).
        iterations: Number of refits so far, (batch,).
        has_elites: Whether any candidate so far had a finite return, (batch,).
    """

    mean: Tensor
    var: Tensor
    elites: Elites | None
    expected_return: Tensor
    num_nonfinite: Tensor
    iterations: Tensor
    has_elites: Tensor

    def updated(self, mask: Tensor, new: Progress) -> Progress:
        """Returns this progress, with the environments in mask (batch,) taken from `new`."""

        def select(newer: Any, older: Any) -> Any:
            if not isinstance(newer, Tensor):
                return newer
            return torch.where(mask.reshape(-1, *[1] * (newer.ndim - 1)), newer, older)

        selected: Progress = tree_map(select, new, self)
        return selected

    def describe(self, history: Sequence[tuple[Tensor, Tensor]], stopped: str) -> dict[str, Any]:
        """Returns the diagnostics of a plan.

        Args:
            history: The elites' mean return and the mean sampling std after each refit, both (batch,).
            stopped: The reason the search ended.
        """
        none = self.expected_return.new_zeros(len(self.expected_return), 0)
        return {
            "elite_return": torch.stack([elite_return for elite_return, _ in history], dim=1) if history else none,
            "std": torch.stack([std for _, std in history], dim=1) if history else none,
            "iterations": self.iterations,
            "num_nonfinite": self.num_nonfinite,
            "is_fallback": ~self.has_elites,
            "stopped": stopped,
        }


class Search:
    """One search for a problem, with the options of a planner.

    Args:
        options: Options of the search.
        problem: Model, start, objective and bounds.
        generator: See `CEMPlanner.plan`.

    Raises:
        ValueError: The model lacks a method that an option needs.
    """

    def __init__(self, options: SearchOptions, problem: Problem, generator: Generators) -> None:
        model, objective = apply_view(problem.model, problem.objective)
        self.options, self.model, self.state = options, model, problem.state
        self.batch, self.device = count_rows(self.state), state_device(self.state)
        self.dtype = action_dtype(self.state)
        self.low, self.high = self._constant(problem.low), self._constant(problem.high)
        self.horizon = options.horizon if objective is None else options.goal_horizon or options.horizon
        self.min_std = torch.full_like(self.low, options.min_std)
        if problem.init_std is None:
            self.init_std = (self.high - self.low) / 4
            self.min_std = torch.minimum(self.min_std, self.init_std)
        else:
            self.init_std = self._constant(problem.init_std)
        self.num_proposals = options.num_proposals(supports(model, "policy"))
        # The policy was trained on the task's reward, so it may not replace a plan for another objective.
        self.may_use_policy = self.num_proposals > 0 and objective is None and not problem.constraints
        self.streams = Streams(generator, self.batch, self.device)
        self.scorer = Scorer.build(
            model,
            objective,
            problem.constraints,
            problem.discount ** torch.arange(self.horizon + 1, dtype=self.dtype, device=self.device),
            terminal_value=options.terminal_value,
            use_continues=options.use_continues,
            penalty=options.constraint_penalty,
        )

    def budget(self, pace: Pace, clock: Callable[[], float], started: float, seconds: float | None) -> Budget:
        """Returns the time that this search may take; see `Budget`."""
        # The speed of a wrapper such as `compile_rollout` depends on the model inside, so both types are in the key.
        kind = type(self.model), type(getattr(self.model, "model", None))
        size = (kind, self.batch, self.horizon, self.scorer.num_particles, self.dtype, self.device)
        return Budget(pace, size, clock, started, seconds, self.device)

    def run(self, previous: Plan | None, budget: Budget) -> Plan:
        """Returns the plan; the environments in which the previous plan is still valid start from it.

        Args:
            previous: The previous plan; None starts everywhere without one.
            budget: The time that the search may take.
        """
        options = self.options
        shifted = self._cold_start() if previous is None else self._shift(previous)
        start = shifted if options.warm_start else self._cold_start()
        if not budget.allows("propose", "iteration", "choose"):
            return self._fall_back(shifted, budget)
        budget.lap()
        proposals = self._propose(budget) if self.num_proposals else None
        progress, history, stopped = self._iterate(start, proposals, budget)
        # Without a finite candidate the plan is the tail of the previous plan, or zeros clamped into the bounds.
        mean = torch.where(progress.has_elites[:, None, None], progress.mean, shifted.mean).clamp(self.low, self.high)
        mode = proposals[:, 0] if proposals is not None and self.may_use_policy else None
        actions, expected, violation = choose(options.final, self.scorer, self.state, progress, mean, mode)
        budget.lap("choose")
        if options.gradient_steps and not budget.allows("gradient"):
            stopped = "deadline"
        elif options.gradient_steps:
            actions, refined, violation = self._refine(actions)
            expected = torch.where(torch.isfinite(refined), refined, expected)
            budget.lap("gradient")
        info = {**progress.describe(history, stopped), "is_policy": torch.zeros_like(progress.has_elites)}
        if violation is not None:
            info["violation"] = violation
        kept = None
        if progress.elites is not None and options.num_kept:
            kept = progress.elites.actions[:, : options.num_kept]
        ones = torch.ones(self.batch, dtype=torch.long)
        return Plan(actions, mean, progress.var, expected, info, kept, ones.bool(), ones)

    def _propose(self, budget: Budget) -> Tensor:
        generators, bounds = self.streams.policy_generators(), (self.low, self.high)
        proposals = self.scorer.propose(self.state, self.num_proposals, generators, bounds)
        budget.lap("propose")
        return proposals

    def _fall_back(self, shifted: WarmStart, budget: Budget) -> Plan:
        """Returns a plan when the deadline is too short for a search.

        The actions are the policy's sequence, else the shifted previous plan, else zeros. The policy's sequence is a
        rollout of its mode if the budget allows a rollout, else its action in the present state, repeated. Environments
        that would start cold stay cold.
        """
        actions, is_policy = shifted.mean, torch.zeros(self.batch, dtype=torch.bool, device=self.device)
        if self.may_use_policy:
            budget.lap()
            if budget.allows("propose"):
                mode = self._propose(budget)[:, 0]
            else:
                mode = self.scorer.act(self.state, (self.low, self.high))[:, None].expand_as(actions)
            is_policy = torch.isfinite(mode).flatten(1).all(1)
            actions = torch.where(is_policy[:, None, None], mode, actions)
        progress = self._begin(shifted)
        info = {**progress.describe([], "deadline"), "is_policy": is_policy}
        if self.scorer.constraints:
            info["violation"] = torch.full_like(progress.expected_return, float("nan"))
        ones = torch.ones(self.batch, dtype=torch.long)
        elites, is_warm = shifted.elites, shifted.is_warm
        return Plan(actions, shifted.mean, progress.var, progress.expected_return, info, elites, is_warm, ones)

    def _iterate(
        self, start: WarmStart, proposals: Tensor | None, budget: Budget
    ) -> tuple[Progress, list[tuple[Tensor, Tensor]], str]:
        """Refits the distribution until the iterations or the time are used up.

        Returns:
            The last progress, the elites' mean return and the mean sampling std (batch,) after each refit, and the
            reason the loop ended: "iterations" or "deadline".
        """
        options, num_fresh = self.options, self.options.num_samples - self.num_proposals
        progress = self._begin(start)
        std = self._sampling_std(progress.var)[:, None]
        limit = torch.where(start.is_warm, options.num_warm_iterations, options.num_iterations)
        num_common = int(limit.min())
        known: list[Candidates] = []
        history, stopped = [], "iterations"
        for iteration in range(int(limit.max())):
            is_first = iteration == 0
            if not is_first and not budget.allows("iteration", "choose"):
                stopped = "deadline"
                break
            fresh = self._sample(progress.mean[:, None], std, num_fresh)
            fresh[:, 0] = start.mean if is_first else progress.mean.clamp(self.low, self.high)
            if is_first:
                self._place_elites(fresh, start)
                fresh = fresh if proposals is None else torch.cat([fresh, proposals], dim=1)
            if iteration <= 1:  # later iterations have as many candidates as the second, which has no new proposals
                rows = self.scorer.start_rows(self.state, fresh.shape[1])
            scores = self.scorer.score(rows, fresh)
            if is_first:
                scores = _ignore_nan_actions(fresh, scores)
            updated = self._refit(progress, [(fresh, scores), *known, *self._keep(progress, known)], scores.returns)
            if is_first:  # the policy's proposals and the shifted previous plan stay candidates, with their scores
                known = [(fresh[:, num_fresh:], scores.rest(num_fresh)), (fresh[:, :1], scores.first(1))]
            elif iteration >= num_common:  # environments that have used up their iterations stay as they are
                updated = progress.updated((limit > iteration).to(self.device), updated)
            progress = updated
            std = self._sampling_std(progress.var)[:, None]
            history.append((progress.expected_return, std.mean(dim=(1, 2, 3))))
            budget.lap("iteration")
        return progress, history, stopped

    def _begin(self, start: WarmStart) -> Progress:
        """Returns the progress before the first refit."""
        zeros = torch.zeros(self.batch, dtype=torch.long, device=self.device)
        unknown = torch.full((self.batch,), float("nan"), dtype=self.dtype, device=self.device)
        var = self.init_std.square().expand_as(start.mean)
        return Progress(start.mean, var, None, unknown, zeros, zeros, zeros.bool())

    def _sample(self, mean: Tensor, std: Tensor, num: int) -> Tensor:
        """Returns `num` sequences per environment within the bounds, (batch, num, horizon, action)."""
        noise = self.streams.noise(num, self.horizon, len(self.low), self.options.noise_beta, self.dtype)
        samples = torch.addcmul(mean, std, noise)
        return torch.minimum(torch.maximum(samples, self.low, out=samples), self.high, out=samples)

    def _place_elites(self, fresh: Tensor, start: WarmStart) -> None:
        """Puts the shifted elites of the previous plan among the candidates of the warm environments."""
        if start.elites is not None:
            end = min(1 + start.elites.shape[1], fresh.shape[1])
            is_warm = start.is_warm.to(self.device)[:, None, None, None]
            fresh[:, 1:end] = torch.where(is_warm, start.elites[:, : end - 1], fresh[:, 1:end])

    def _keep(self, progress: Progress, known: Sequence[Candidates]) -> list[Candidates]:
        """Returns the best elites of the last refit, which stay candidates.

        Elites that are also among the `known` candidates get the return NaN, so that no sequence counts twice.
        """
        needs_best = self.options.final == "best" or bool(self.scorer.constraints)
        num = max(self.options.num_kept, int(needs_best))
        if progress.elites is None or num == 0:
            return []
        actions, scores = progress.elites.actions[:, :num], progress.elites.scores.first(num)
        others = torch.cat([sequences for sequences, _ in known], dim=1)
        is_known = (actions[:, :, None] == others[:, None]).flatten(3).all(dim=3).any(dim=2)
        return [(actions, scores._replace(returns=scores.returns.masked_fill(is_known, float("nan"))))]

    def _refit(self, progress: Progress, candidates: list[Candidates], fresh_returns: Tensor) -> Progress:
        options = self.options
        elites = select_elites(
            torch.cat([actions for actions, _ in candidates], dim=1),
            Scores.join([scores for _, scores in candidates]),
            num_elites=options.num_elites,
            temperature=options.temperature,
        )
        mean, var = move_towards(
            elites, progress.mean, progress.var, smoothing=options.smoothing, adapt_std=options.adapt_std
        )
        has_elites = elites.weights.sum(dim=1) > 0
        return Progress(
            mean,
            var,
            elites,
            torch.where(has_elites, mean_return(elites), progress.expected_return),
            progress.num_nonfinite + (~torch.isfinite(fresh_returns)).sum(dim=1),
            progress.iterations + 1,
            progress.has_elites | has_elites,
        )

    def _refine(self, actions: Tensor) -> Choice:
        return ascend(
            self.scorer,
            self.state,
            actions,
            num_steps=self.options.gradient_steps,
            step_size=self.options.gradient_step_size,
            bounds=(self.low, self.high),
        )

    def _cold_start(self) -> WarmStart:
        shape = (self.batch, self.horizon, len(self.low))
        mean = torch.zeros_like(self.low).clamp(self.low, self.high).expand(shape)
        return WarmStart(mean, None, torch.zeros(self.batch, dtype=torch.bool))

    def _shift(self, previous: Plan) -> WarmStart:
        (batch, _, dim), bounds = previous.mean.shape, (self.low, self.high)
        if (batch, dim) != (self.batch, len(self.low)):
            sizes = f"{self.batch} environments and actions of {len(self.low)}"
            raise ValueError(f"the last plan is for {batch} environments and actions of {dim}, this search for {sizes}")
        return shift_plan(
            previous,
            horizon=self.horizon,
            tail=self.options.tail,
            bounds=bounds,
            policy_tail=lambda actions, is_tail: self.scorer.continue_by_policy(self.state, actions, is_tail, bounds),
        )

    def _sampling_std(self, var: Tensor) -> Tensor:
        return torch.maximum(var.sqrt(), self.min_std)

    def _constant(self, value: Tensor) -> Tensor:
        return value.to(dtype=self.dtype, device=self.device)


def choose(
    final: str, scorer: Scorer, state: State, progress: Progress, mean: Tensor, policy_mode: Tensor | None
) -> Choice:
    """Returns the sequence of a finished search that is executed, its expected return and its violation.

    Args:
        final: `mean`; `best`, the best candidate; or `better`, the mean or the policy's mode sequence by return.
        scorer: Scores sequences.
        state: Start of the plans, rows (batch,).
        progress: End of the search.
        mean: Mean of the final distribution, within the bounds, (batch, horizon, action).
        policy_mode: The policy's mode sequence, (batch, horizon, action); None if the policy may not replace the plan,
            so that `better` is `mean`.
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
    """Returns the mean or the policy's mode, by predicted return; the mean where neither return is finite.

    The mean of several good sequences is another sequence, and may have a lower return than the policy's mode.
    """
    is_finite = torch.isfinite(policy_mode).flatten(1).all(1)  # a model may give an action that is NaN a finite return
    both = torch.stack([mean, torch.where(is_finite[:, None, None], policy_mode, mean)], dim=1)
    better = select_elites(both, scorer.score(scorer.start_rows(state, 2), both), num_elites=1, temperature=None)
    is_known = better.weights[:, 0] > 0
    actions = torch.where(is_known[:, None, None], better.actions[:, 0], mean)
    return actions, torch.where(is_known, better.scores.returns[:, 0], progress.expected_return), None


def _choose_feasible(final: str, scorer: Scorer, state: State, progress: Progress, mean: Tensor) -> Choice:
    """Returns the mean, or under constraints the best candidate where the mean violates them more."""
    assert progress.elites is not None
    best, scores = progress.elites.actions[:, 0], progress.elites.scores
    mean_scores = scorer.score(scorer.start_rows(state, 1), mean[:, None])
    assert mean_scores.violations is not None and scores.violations is not None
    violation, best_violation = mean_scores.violations[:, 0], scores.violations[:, 0]
    best_return = scores.returns[:, 0]
    is_best = torch.isfinite(best_return)
    if final != "best":  # the mean of feasible sequences may itself be infeasible
        is_safer = best_violation < violation.nan_to_num(float("inf"))
        is_best = is_best & is_safer if scores.is_ranked else torch.zeros_like(is_best)
    return (
        torch.where(is_best[:, None, None], best, mean),
        torch.where(is_best, best_return, progress.expected_return),
        torch.where(is_best, best_violation, violation),
    )


def _ignore_nan_actions(candidates: Tensor, scores: Scores) -> Scores:
    """Returns the scores with the return NaN where a candidate is not finite, so that it is never an elite.

    A policy may propose NaN, and a model may give such a sequence a finite return.
    """
    is_finite = torch.isfinite(candidates).flatten(2).all(dim=2)
    return scores._replace(returns=scores.returns.masked_fill(~is_finite, float("nan")))
