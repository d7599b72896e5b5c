"""One search, from the candidates to the plan: the loop that every planner of the family runs."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from latentplan.planning.conditioned import seen_for
from latentplan.planning.model import Model, State, action_dtype, count_rows, per_dimension, state_device
from latentplan.planning.objectives import Constraint, Term
from latentplan.planning.plan import Plan, WarmStart, shift_plan
from latentplan.planning.search.choice import choose
from latentplan.planning.search.deadline import Budget
from latentplan.planning.search.elites import Scores, mean_return, move_towards, select_elites
from latentplan.planning.search.gradient import ascend
from latentplan.planning.search.progress import Progress
from latentplan.planning.search.sampling import Generators, Streams
from latentplan.planning.search.scorer import Scorer

if TYPE_CHECKING:
    from latentplan.planning.search.cem import CEMPlanner

Candidates = tuple[Tensor, Scores]  # sequences (batch, sample, horizon, action) and how good they are


class Search:
    """The search problem of one call, and the settings it is solved with.

    Args:
        options: The planner whose settings hold.
        model: What imagines.
        state: Where plans start, rows (batch,).
        objective: What is maximised; None for the predicted return.
        constraints: What candidates must keep.
        generator: See `CEMPlanner.plan`.
        started: When the call began, by the planner's clock.
        deadline_ms: What the call may take; None is as long as it likes.

    Raises:
        ValueError: The model lacks what a setting asks for.
    """

    def __init__(
        self,
        options: CEMPlanner,
        model: Model,
        state: State,
        objective: Term | None,
        constraints: Sequence[Constraint],
        generator: Generators,
        started: float,
        deadline_ms: float | None,
    ) -> None:
        model, objective = seen_for(model, objective)
        self.options, self.state = options, state
        self.batch, self.device, self.dtype = count_rows(state), state_device(state), action_dtype(state)
        self.low = self._constant(options.action_low, "action_low")
        self.high = self._constant(options.action_high, "action_high")
        self.horizon = options.horizon if objective is None else options.goal_horizon or options.horizon
        half_range = (self.high - self.low) / 2
        self.init_std = half_range if options.init_std is None else self._constant(options.init_std, "init_std")
        # Only what the policy was trained for is its business.
        self.may_follow_policy = options.num_policy_samples > 0 and objective is None and not constraints
        self.streams = Streams(generator, self.batch, self.device)
        discounts = options.discount ** torch.arange(self.horizon + 1, dtype=self.dtype, device=self.device)
        self.scorer = Scorer.build(
            model,
            objective,
            constraints,
            discounts,
            terminal_value=options.terminal_value,
            use_continues=options.use_continues,
            penalty=options.constraint_penalty,
        )
        kind = type(model), type(getattr(model, "model", None))  # what it wraps may be slower than what another does
        size = (kind, self.batch, self.horizon, self.scorer.num_particles, self.dtype, self.device)
        seconds = None if deadline_ms is None else deadline_ms / 1000
        self.budget = Budget(options.pace, size, options.clock or time.perf_counter, started, seconds, self.device)

    def run(self, previous: Plan | None) -> Plan:
        """The plan, warm-started from the last one in the environments where it may be."""
        options = self.options
        last = self._cold_start() if previous is None else self._shift(previous)
        start = last if options.warm_start else self._cold_start()
        if not self.budget.allows("propose", "iteration", "choose"):
            return self._fall_back(last)
        self.budget.lap()
        proposals = self._propose() if options.num_policy_samples else None
        progress, history, stopped = self._iterate(start, proposals)
        # Where nothing finite was found: the last plan's tail, or zeros clamped into the bounds.
        mean = torch.where(progress.is_found[:, None, None], progress.mean, last.mean).clamp(self.low, self.high)
        mode = proposals[:, 0] if proposals is not None and self.may_follow_policy else None
        actions, expected, violation = choose(options.final, self.scorer, self.state, progress, mean, mode)
        self.budget.lap("choose")
        if options.gradient_steps and not self.budget.allows("gradient"):
            stopped = "deadline"
        elif options.gradient_steps:
            actions, refined, violation = ascend(
                self.scorer,
                self.state,
                actions,
                num_steps=options.gradient_steps,
                step_size=options.gradient_step_size,
                bounds=(self.low, self.high),
            )
            expected = torch.where(torch.isfinite(refined), refined, expected)
            self.budget.lap("gradient")
        info = {**progress.describe(history, stopped), "is_policy": torch.zeros_like(progress.is_found)}
        if violation is not None:
            info["violation"] = violation
        kept = None
        if progress.elites is not None and options.num_kept:
            kept = progress.elites.actions[:, : options.num_kept]
        ones = torch.ones(self.batch, dtype=torch.long)
        return Plan(actions, mean, progress.var, expected, info, kept, ones.bool(), ones)

    def _propose(self) -> Tensor:
        generators, bounds = self.streams.policy_generators(), (self.low, self.high)
        proposals = self.scorer.propose(self.state, self.options.num_policy_samples, generators, bounds)
        self.budget.lap("propose")
        return proposals

    def _hold_policy(self) -> Tensor:
        """The policy's mode here and now, (batch, 1, action)."""
        return self.scorer.act(self.state, (self.low, self.high))[:, None]

    def _fall_back(self, last: WarmStart) -> Plan:
        """Where there is no time to search: what the policy does; without one the shifted last plan, or zeros.

        It is the policy's mode in imagination if that fits, else its action now, held. What is cold stays cold.
        """
        actions, is_policy = last.mean, torch.zeros(self.batch, dtype=torch.bool, device=self.device)
        if self.may_follow_policy:
            self.budget.lap()
            mode = self._propose()[:, 0] if self.budget.allows("propose") else self._hold_policy().expand_as(actions)
            is_policy = torch.isfinite(mode).flatten(1).all(1)
            actions = torch.where(is_policy[:, None, None], mode, actions)
        progress, _, _ = self._begin(last, None, 1)
        info = {**progress.describe([], "deadline"), "is_policy": is_policy}
        if self.scorer.constraints:
            info["violation"] = torch.full_like(progress.expected_return, float("nan"))
        ones = torch.ones(self.batch, dtype=torch.long)
        return Plan(actions, last.mean, last.var, progress.expected_return, info, last.elites, last.is_warm, ones)

    def _iterate(self, start: WarmStart, proposals: Tensor | None) -> tuple[Progress, list[tuple[Tensor, Tensor]], str]:
        """The refits; after each, the elites' mean return and the mean sampling std, both (batch,); what ended them."""
        options, num_fresh = self.options, self.options.num_samples - self.options.num_policy_samples
        progress, centre, spread = self._begin(start, proposals, num_fresh)
        warm_iterations = options.warm_start_iterations or options.num_iterations
        budget = torch.where(start.is_warm, warm_iterations, options.num_iterations)
        num_common = int(budget.min())
        is_active = torch.ones(self.batch, dtype=torch.bool, device=self.device)
        known: list[Candidates] = []
        history, stopped = [], "iterations"
        for iteration in range(int(budget.max())):
            if iteration and not self.budget.allows("iteration", "choose"):
                stopped = "deadline"
                break
            fresh = self._sample(centre, spread, num_fresh)
            fresh[:, 0] = progress.mean.clamp(self.low, self.high) if iteration else start.mean
            if iteration == 0:
                self._place_elites(fresh, start)
                fresh = fresh if proposals is None else torch.cat([fresh, proposals], dim=1)
            if iteration <= 1:  # the proposals are scored once
                rows = self.scorer.start_rows(self.state, fresh.shape[1])
            scores = self.scorer.score(rows, fresh)
            if iteration == 0:  # what a policy says may be NaN, and a model may not mind: it must not become an elite
                is_finite = torch.isfinite(fresh).flatten(2).all(dim=2)
                scores = scores._replace(returns=scores.returns.masked_fill(~is_finite, float("nan")))
            updated = self._refit(progress, [(fresh, scores), *known, *self._kept(progress, known)], scores.returns)
            if iteration == 0:  # the policy's proposals and the shifted last plan stay among the candidates
                known = [(fresh[:, num_fresh:], scores.rest(num_fresh)), (fresh[:, :1], scores.first(1))]
            elif iteration >= num_common or options.stop_std > 0:
                updated = progress.updated(is_active & (budget > iteration).to(self.device), updated)
            progress = updated
            spread = self._sampling_std(progress.var)[:, None]
            centre = progress.mean[:, None]
            history.append((progress.expected_return, spread.mean(dim=(1, 2, 3))))
            self.budget.lap("iteration")
            if options.stop_std > 0:
                is_active = is_active & (progress.var.amax(dim=(1, 2)).sqrt() >= options.stop_std)
                if not bool(is_active.any()):
                    stopped = "agreement"
                    break
        return progress, history, stopped

    def _begin(self, start: WarmStart, proposals: Tensor | None, num_fresh: int) -> tuple[Progress, Tensor, Tensor]:
        """The first distribution, and the centre and std of its samples, (batch, 1 or sample, horizon, action)."""
        mean, var = start.mean, start.var
        centre, spread = mean[:, None], self._sampling_std(var)[:, None]
        if proposals is not None and self.options.start != "shifted":
            mode = proposals[:, 0]
            mode = torch.where(torch.isfinite(mode), mode, mean)  # a policy that fails leaves the last plan
            mode_std = self.init_std.clamp_min(self.options.min_std).expand_as(mode)
            if self.options.start == "policy":
                mean, var = mode, self.init_std.square().expand_as(mode)
                centre, spread = mode[:, None], mode_std[:, None]
            else:
                is_policy = (torch.arange(num_fresh, device=self.device) % 2 == 1)[:, None, None]
                centre = torch.where(is_policy, mode[:, None], centre)
                spread = torch.where(is_policy, mode_std[:, None], spread)
                mean = (mean + mode) / 2
        nothing = torch.zeros(self.batch, dtype=torch.long, device=self.device)
        unknown = torch.full((self.batch,), float("nan"), dtype=self.dtype, device=self.device)
        return Progress(mean, var, None, unknown, nothing, nothing, nothing.bool()), centre, spread

    def _sample(self, centre: Tensor, spread: Tensor, num: int) -> Tensor:
        options = self.options
        noise = self.streams.noise(num, self.horizon, options.action_dim, options.noise_beta, self.dtype)
        samples = torch.addcmul(centre, spread, noise)
        return torch.minimum(torch.maximum(samples, self.low, out=samples), self.high, out=samples)

    def _place_elites(self, fresh: Tensor, start: WarmStart) -> None:
        """Puts the shifted elites of the last plan among the candidates of the warm environments."""
        if start.elites is not None:
            end = min(1 + start.elites.shape[1], fresh.shape[1])
            is_warm = start.is_warm.to(self.device)[:, None, None, None]
            fresh[:, 1:end] = torch.where(is_warm, start.elites[:, : end - 1], fresh[:, 1:end])

    def _kept(self, progress: Progress, known: Sequence[Candidates]) -> list[Candidates]:
        """The best of the last elites, which stay candidates; one that is `known` anyway does not count twice."""
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
        is_found = elites.weights.sum(dim=1) > 0
        return Progress(
            mean,
            var,
            elites,
            torch.where(is_found, mean_return(elites), progress.expected_return),
            progress.num_nonfinite + (~torch.isfinite(fresh_returns)).sum(dim=1),
            progress.iterations + 1,
            progress.is_found | is_found,
        )

    def _cold_start(self) -> WarmStart:
        shape = (self.batch, self.horizon, self.options.action_dim)
        mean = torch.zeros_like(self.low).clamp(self.low, self.high).expand(shape)
        return WarmStart(mean, self.init_std.square().expand(shape), None, torch.zeros(self.batch, dtype=torch.bool))

    def _shift(self, previous: Plan) -> WarmStart:
        (batch, _, dim), bounds = previous.mean.shape, (self.low, self.high)
        if (batch, dim) != (self.batch, self.options.action_dim):
            ours = f"{self.batch} environments and actions of {self.options.action_dim}"
            raise ValueError(f"the last plan is for {batch} environments and actions of {dim}, this search for {ours}")
        return shift_plan(
            previous,
            horizon=self.horizon,
            tail=self.options.tail,
            variance=self.options.warm_start_variance,
            initial_var=self.init_std.square(),
            bounds=bounds,
            policy_tail=lambda actions, is_tail: self.scorer.continue_by_policy(self.state, actions, is_tail, bounds),
        )

    def _sampling_std(self, var: Tensor) -> Tensor:
        return var.sqrt().clamp_min(self.options.min_std)

    def _constant(self, value: float | Sequence[float] | Tensor, name: str) -> Tensor:
        return per_dimension(value, self.options.action_dim, name).to(dtype=self.dtype, device=self.device)
