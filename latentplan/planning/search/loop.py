"""One search, from the first candidates to the plan: the loop that CEM, iCEM and MPPI run.

`Search.run` makes a plan in these steps:

1.  shift the previous plan to the present; its actions are the start of the search distribution;
2.  let the model's policy propose action sequences;
3.  repeat: sample candidates from the distribution, score them in the model, select the elites, and move mean and
    variance towards the elites;
4.  choose the sequence to execute (`choice`);
5.  if asked, refine this sequence by gradient ascent (`gradient`).

The distribution lives in the space of `space`, and candidates become actions there. A search with a deadline skips the
parts that would end too late (`deadline`). Scores come from `scorer`, and the equations of step 3 from `elites`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from latentplan.config.planner import SearchOptions
from latentplan.planning.model import State, action_dtype, count_rows, has_policy, is_sampling, state_device
from latentplan.planning.objectives import apply_view
from latentplan.planning.plan import Iteration, Plan, WarmStart, shift_plan
from latentplan.planning.search.choice import Choice, Finalists, choose
from latentplan.planning.search.choices import Choices
from latentplan.planning.search.deadline import Budget, Pace
from latentplan.planning.search.elites import (
    Scores,
    mean_return,
    move_towards,
    select_elites,
    spread_of_returns,
)
from latentplan.planning.search.gradient import Pause, ascend
from latentplan.planning.search.problem import (
    Problem,
    View,
    find_spreads,
    fit_steps,
    make_space,
    split_limits,
)
from latentplan.planning.search.progress import Progress
from latentplan.planning.search.purity import Watch, describe_writing
from latentplan.planning.search.sampling import Generators, Streams
from latentplan.planning.search.scorer import Scorer
from latentplan.planning.search.space import Bounds

Candidates = tuple[Tensor, Scores]
"""Points (batch, sample, length, action) and the scores of their actions."""


class Search:
    """One search for a problem, with the options of a planner.

    Args:
        options: Options of the search.
        problem: Model, start, objective and bounds.
        generator: See `CEMPlanner.plan`.
        previous: The previous plan; None starts everywhere without one.
        view: What the caller sees of the search.

    Raises:
        ValueError: The model lacks a method that an option needs, or a size does not fit the state.
    """

    def __init__(
        self,
        options: SearchOptions,
        problem: Problem,
        generator: Generators,
        previous: Plan | None = None,
        view: View | None = None,
    ) -> None:
        model, objective = apply_view(problem.model, problem.objective)
        self.options, self.model, self.state, self.view = options, model, problem.state, view or View()
        self.batch, self.device = count_rows(self.state), state_device(self.state)
        self.dtype = action_dtype(self.state)
        self.problem, self.previous = problem, previous
        self.is_new = problem.first_searches.is_new(problem.model)
        self.horizon = options.horizon if objective is None else options.goal_horizon or options.horizon
        low, high = (self._per_step(value, name) for name, value in (("low", problem.low), ("high", problem.high)))
        choices = Choices(problem.choices, self.dtype, self.device) if problem.choices else None
        self.bounds = Bounds(low, high, choices)
        self._check_previous()
        limits, constraints = split_limits(problem.constraints)
        find_last = self._find_last_action()
        self.space = make_space(options, self.bounds, self.horizon, limits, find_last)
        init_std = None if problem.init_std is None else self._per_step(problem.init_std, "init_std")
        spreads = find_spreads(self.bounds, init_std, options.min_std)
        self.init_std, self.min_std = (self.space.at_points(spread) for spread in spreads)
        rest = (low + high) / 2 if problem.init_mean is None else self._per_step(problem.init_mean, "init_mean")
        self.rest = self.bounds.fit(rest).expand(self.batch, self.horizon, -1)
        self.num_proposals = options.num_proposals(has_policy(model))
        # The policy was trained on the task's reward, so it may not replace a plan for another objective.
        self.may_use_policy = self.num_proposals > 0 and objective is None and not constraints
        self.streams = Streams(generator, self.batch, self.device)
        self.scorer = Scorer.build(
            model,
            objective,
            constraints,
            problem.discount ** torch.arange(self.horizon + 1, dtype=self.dtype, device=self.device),
            terminal_value=options.terminal_value,
            use_continues=options.use_continues,
            penalty=options.constraint_penalty,
            generator=self.streams.model_generator() if is_sampling(model) else None,
            find_last_action=find_last,
        )

    def budget(self, pace: Pace, clock: Callable[[], float], started: float, seconds: float | None) -> Budget:
        """Returns the time that this search may take; see `Budget`."""
        # The speed of a wrapper such as `compile_rollout` depends on the model inside, so both types are in the key.
        inner = getattr(self.model, "_model", getattr(self.model, "model", None))
        models = type(self.model), type(inner)
        size = (models, self.batch, self.horizon, self.scorer.num_particles, self.dtype, self.device)
        kind = (*self.scorer.kind, self.view.keep == "states")
        return Budget(pace, size, kind, clock, started, seconds, self.device)

    def run(self, budget: Budget) -> Plan:
        """Returns the plan; the environments in which the previous plan is still valid start from it.

        Args:
            budget: The time that the search may take.
        """
        options, space = self.options, self.space
        shifted = self._cold_start() if self.previous is None else self._shift(self.previous)
        start = shifted if options.warm_start else self._cold_start()
        if not budget.allows("propose", "iteration", "choose"):
            return self._fall_back(shifted, budget)
        budget.lap()
        proposals = self._propose(budget) if self.num_proposals else None
        progress, iterations, history, stopped = self._iterate(self._encode(start), proposals, budget)
        # Without a finite candidate the plan is the tail of the previous plan, or the start of a cold search.
        has_elites = progress.has_elites[:, None, None]
        mean = space.decode(space.clean(torch.where(has_elites, progress.mean, space.encode(shifted.mean))))
        choice = self._choose(progress, mean, proposals)
        budget.lap("choose")
        pause = self._pause() if options.gradient_steps else None
        if pause is not None:
            choice, pause, is_late = self._refine(choice, pause, progress, budget)
            stopped = "deadline" if is_late else stopped
        actions, expected, violation = choice
        info = {**progress.describe(history, stopped), "is_policy": torch.zeros_like(progress.has_elites)}
        info |= _describe_rest(progress, self._add_excess(violation, actions), pause)
        kept = None
        if progress.elites is not None and options.num_kept:
            kept = space.carry(progress.elites.actions[:, : options.num_kept])
        ones = torch.ones(self.batch, dtype=torch.long, device="cpu")
        var, is_warm = space.decode_var(progress.var), start.is_warm
        if not bool(is_warm.all()):  # only then, because reading from a graphics processor waits for it
            is_warm = is_warm | progress.has_elites.cpu()
        return Plan(actions, mean, var, expected, info, kept, is_warm, ones, candidates=tuple(iterations))

    def _choose(self, progress: Progress, mean: Tensor, proposals: Tensor | None) -> Choice:
        assert progress.elites is not None
        best = self.space.decode(progress.elites.actions[:, :1])[:, 0]
        mode = proposals[:, 0] if proposals is not None and self.may_use_policy else None
        finalists = Finalists(mean, best, progress.elites.scores.first(1), progress.expected_return, mode)
        return choose(self.options.final, self.options.policy_margin, self.scorer, self.state, finalists)

    def _propose(self, budget: Budget) -> Tensor:
        generators = self.streams.policy_generators()
        proposals = self.scorer.propose(self.state, self.num_proposals, generators, self.bounds)
        budget.lap("propose")
        return proposals if self.space.is_plain else self.space.decode(self.space.encode(proposals))

    def _fall_back(self, shifted: WarmStart, budget: Budget) -> Plan:
        """Returns a plan when the deadline is too short for a search.

        The actions are the policy's sequence, else the shifted previous plan, else the start of a cold search. The
        policy's sequence is a rollout of its mode if the budget allows a rollout, else its action in the present state,
        repeated. Environments that would start cold stay cold.
        """
        actions, is_policy = shifted.mean, torch.zeros(self.batch, dtype=torch.bool, device=self.device)
        if self.may_use_policy:
            budget.lap()
            if budget.allows("propose"):
                mode = self._propose(budget)[:, 0]
            else:
                mode = self.bounds.fit(self.scorer.act(self.state, self.bounds)[:, None].expand_as(actions))
            is_policy = torch.isfinite(mode).flatten(1).all(1)
            actions = torch.where(is_policy[:, None, None], mode, actions)
        if not self.space.is_plain:
            actions = self.space.decode(self.space.encode(actions))
        progress = self._begin(self._encode(shifted))
        unknown = torch.full_like(progress.expected_return, float("nan")) if self.scorer.constraints else None
        pause = self._pause() if self.options.gradient_steps else None
        info = {**progress.describe([], "deadline"), "is_policy": is_policy}
        info |= _describe_rest(progress, self._add_excess(unknown, actions), pause)
        ones = torch.ones(self.batch, dtype=torch.long, device="cpu")
        elites, is_warm = shifted.elites, shifted.is_warm
        mean, var = self.space.decode(progress.mean), self.space.decode_var(progress.var)
        return Plan(actions, mean, var, progress.expected_return, info, elites, is_warm, ones)

    def _iterate(
        self, start: WarmStart, proposals: Tensor | None, budget: Budget
    ) -> tuple[Progress, list[Iteration], list[tuple[Tensor, Tensor]], str]:
        """Refits the distribution until the iterations or the time are used up.

        Returns:
            The last progress, the iterations that the caller keeps, the elites' mean return and the mean sampling std
            (batch,) after each refit, and the reason the loop ended: "iterations" or "deadline".
        """
        options, num_fresh = self.options, self.options.num_samples - self.num_proposals
        progress = self._begin(start)
        std = self._sampling_std(progress.var)
        limit = torch.where(start.is_warm, options.num_warm_iterations, options.num_iterations)
        num_common = int(limit.min())
        known: list[Candidates] = []
        kept: list[Iteration] = []
        history, stopped = [], "iterations"
        for iteration in range(int(limit.max())):
            is_first = iteration == 0
            if not is_first and not budget.allows("iteration", "choose"):
                stopped = "deadline"
                break
            fresh = self._sample(progress, std, num_fresh)
            fresh[:, 0] = start.mean if is_first else self.space.clean(progress.mean)
            if is_first:
                self._place_elites(fresh, start)
                fresh = fresh if proposals is None else torch.cat([fresh, self.space.encode(proposals)], dim=1)
            if iteration <= 1:  # later iterations have as many candidates as the second, which has no new proposals
                rows = self.scorer.start_rows(self.state, fresh.shape[1])
            scores, states = self._score(rows, fresh, is_watched=is_first and self.is_new)
            if is_first:
                scores = _ignore_nan_actions(fresh, scores)
            updated = self._refit(progress, [(fresh, scores), *known, *self._keep(progress, known)], scores)
            if is_first:  # the policy's proposals and the shifted previous plan stay candidates, with their scores
                known = [(fresh[:, num_fresh:], scores.rest(num_fresh)), (fresh[:, :1], scores.first(1))]
            elif iteration >= num_common:  # environments that have used up their iterations stay as they are
                updated = progress.updated((limit > iteration).to(self.device), updated)
            progress = updated
            std = self._sampling_std(progress.var)
            history.append((progress.expected_return, std.mean(dim=(1, 2))))
            if self.view.is_open:
                self._show(iteration, fresh, scores, states, progress, kept)
            budget.lap("iteration")
        return progress, kept, history, stopped

    def _score(self, rows: State, points: Tensor, *, is_watched: bool) -> tuple[Scores, State]:
        """Returns the scores of points, and the states of their rollouts if the caller keeps them, else None."""
        actions = self.space.decode(points)
        watch = Watch(rows, actions) if is_watched else None
        with_states = self.view.keep == "states"
        try:
            rollout = self.scorer.imagine(rows, actions, with_states=with_states)
            scores = self.scorer.score_rollout(rollout)
        except Exception as error:
            if is_watched and "single memory location" in str(error):  # rows of one environment share their memory
                raise ValueError(describe_writing(self.model, "state")) from error
            if is_watched:
                error.add_note("check_model(model, state, planner=planner) lists everything that a planner needs")
            raise
        if watch is not None:
            watch.check(self.model, rollout.last_state, len(rollout.actions))
            self.problem.first_searches.add(self.problem.model)
        return scores, self.scorer.arrange_states(rollout) if with_states else None

    def _show(
        self, index: int, points: Tensor, scores: Scores, states: State, progress: Progress, kept: list[Iteration]
    ) -> None:
        """Describes an iteration to the callback and among the kept ones."""
        actions, is_feasible = self.space.decode(points), torch.isfinite(scores.returns)
        violations = self._add_excess(scores.violations, actions)
        if violations is not None:
            is_feasible = is_feasible & (violations == 0)
        assert progress.elites is not None
        is_elite = torch.isfinite(progress.elites.scores.returns)[:, :, None, None]
        described = Iteration(
            index,
            actions,
            scores.returns,
            is_feasible,
            violations,
            states,
            self.space.decode(self.space.clean(progress.mean)),
            self.space.decode_var(progress.var).sqrt(),
            progress.expected_return,
            self.space.decode(progress.elites.actions).masked_fill(~is_elite, torch.nan),
        )
        if self.view.keep is not None:
            kept.append(described)
        if self.view.callback is not None:  # which may write into what it is given
            self.view.callback(described.copied())

    def _add_excess(self, violation: Tensor | None, actions: Tensor) -> Tensor | None:
        """Returns the violation of all constraints, given that of those other than rate limits; None without any."""
        excess = self.space.excess_change(actions)
        if violation is None or excess is None:
            return excess if violation is None else violation
        return violation + excess

    def _begin(self, start: WarmStart) -> Progress:
        """Returns the progress before the first refit."""
        zeros = torch.zeros(self.batch, dtype=torch.long, device=self.device)
        unknown = torch.full((self.batch,), float("nan"), dtype=self.dtype, device=self.device)
        var = self.init_std.square().expand_as(start.mean)
        choices, probabilities = self.space.choices, None
        if choices is not None:
            probabilities = choices.start(start.mean, start.is_warm.to(self.device))
        return Progress(start.mean, var, probabilities, None, unknown, zeros, zeros, zeros.bool())

    def _sample(self, progress: Progress, std: Tensor, num: int) -> Tensor:
        """Returns `num` clean points per environment, (batch, num, length, action)."""
        beta, white_share = self.options.noise_beta, self.options.white_noise_share
        length, action_dim = self.space.length, self.bounds.action_dim
        noise, scale = self.streams.noise(num, length, action_dim, beta, white_share, self.dtype)
        spread = std[:, None] if scale is None else std[:, None] * scale
        samples = torch.addcmul(progress.mean[:, None], spread, noise)
        if progress.probabilities is not None:
            assert self.space.choices is not None
            samples = self.space.choices.sample(samples, progress.probabilities, noise)
        return self.space.clean(samples, in_place=True)

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
        needs_best = needs_best or (self.options.final == "better" and not self.may_use_policy)
        num = max(self.options.num_kept, int(needs_best))
        if progress.elites is None or num == 0:
            return []
        actions, scores = progress.elites.actions[:, :num], progress.elites.scores.first(num)
        others = torch.cat([sequences for sequences, _ in known], dim=1)
        is_known = (actions[:, :, None] == others[:, None]).flatten(3).all(dim=3).any(dim=2)
        return [(actions, scores._replace(returns=scores.returns.masked_fill(is_known, float("nan"))))]

    def _refit(self, progress: Progress, candidates: list[Candidates], fresh: Scores) -> Progress:
        options = self.options
        elites = select_elites(
            torch.cat([actions for actions, _ in candidates], dim=1),
            Scores.join([scores for _, scores in candidates]),
            num_elites=options.num_best,
            temperature=options.temperature,
        )
        mean, var = move_towards(
            elites, progress.mean, progress.var, smoothing=options.smoothing, adapt_std=options.adapt_std
        )
        probabilities = progress.probabilities
        if probabilities is not None and self.space.choices is not None:
            probabilities = self.space.choices.refit(probabilities, elites, options.smoothing)
            mean, var = self.space.choices.describe(mean, var, probabilities)
        has_elites = elites.weights.sum(dim=1) > 0
        return Progress(
            mean,
            var,
            probabilities,
            elites,
            torch.where(has_elites, mean_return(elites), progress.expected_return),
            progress.num_nonfinite + (~fresh.is_finite).sum(dim=1),
            progress.iterations + 1,
            progress.has_elites | has_elites,
        )

    def _pause(self) -> Pause:
        """Returns the pause of gradient refinement, which the previous plan hands on; none where a plan starts cold."""
        none = torch.zeros(self.batch, dtype=torch.long, device=self.device)
        info = {} if self.previous is None else self.previous.info
        if self.previous is None or "gradient_pause" not in info:
            return Pause(none, none)
        is_warm = self.previous.is_warm.to(self.device)
        pause = (info[name].to(self.device) for name in ("gradient_pause", "gradient_wait"))
        return Pause(*(torch.where(is_warm, part, none) for part in pause))

    def _refine(self, choice: Choice, pause: Pause, progress: Progress, budget: Budget) -> tuple[Choice, Pause, bool]:
        """Refines the chosen sequences by gradient ascent, in the environments that do not pause.

        Returns:
            The choice, the pause of the next search, and whether the deadline left no time for the ascent.
        """
        is_due, waited = pause.left == 0, pause.waited()
        if not bool(is_due.any()):
            return choice, waited, False
        if not budget.allows("gradient"):
            return choice, waited, True
        actions, expected, violation = choice
        num_steps, step_size = self.options.gradient_steps, self.options.gradient_step_size
        refined = ascend(self.scorer, self.state, actions, num_steps=num_steps, step_size=step_size, space=self.space)
        actions = torch.where(is_due[:, None, None], refined.actions, actions)
        expected = torch.where(is_due & torch.isfinite(refined.returns), refined.returns, expected)
        if violation is not None and refined.violations is not None:
            violation = torch.where(is_due, refined.violations, violation)
        assert progress.elites is not None
        renewed = pause.renewed(refined.gain, spread_of_returns(progress.elites))
        pause = Pause(*(torch.where(is_due, new, old) for new, old in zip(renewed, waited, strict=True)))
        budget.lap("gradient")
        return (actions, expected, violation), pause, False

    def _cold_start(self) -> WarmStart:
        return WarmStart(self.rest, None, torch.zeros(self.batch, dtype=torch.bool, device="cpu"))

    def _shift(self, previous: Plan) -> WarmStart:
        return shift_plan(
            previous,
            rest=self.rest,
            tail=self.options.tail,
            fit=self.space.fit_carried,
            policy_tail=lambda actions, is_tail: self.scorer.continue_by_policy(
                self.state, actions, is_tail, self.bounds
            ),
        )

    def _encode(self, start: WarmStart) -> WarmStart:
        """Returns a start whose sequences are points of the search space."""
        if self.space.is_plain:
            return start
        elites = None if start.elites is None else self.space.encode(start.elites)
        return WarmStart(self.space.encode(start.mean), elites, start.is_warm)

    def _sampling_std(self, var: Tensor) -> Tensor:
        return torch.maximum(var.sqrt(), self.min_std)

    def _check_previous(self) -> None:
        if self.previous is None:
            return
        if not isinstance(self.previous, Plan):
            kind = type(self.previous).__name__
            raise TypeError(f"previous must be a Plan, got {kind}; Plan.around(actions) makes one of a trajectory")
        batch, _, dim = self.previous.mean.shape
        if (batch, dim) != (self.batch, self.bounds.action_dim):
            sizes = f"{self.batch} environments and actions of {self.bounds.action_dim}"
            raise ValueError(f"the last plan is for {batch} environments and actions of {dim}, this search for {sizes}")

    def _find_last_action(self) -> Callable[[], Tensor] | None:
        """Returns the function that returns the action executed last, (batch, action); None if none can be known."""
        given, previous = self.problem.last_action, self.previous
        if given is not None:
            if given.shape != (self.batch, self.bounds.action_dim):
                shape = (self.batch, self.bounds.action_dim)
                raise ValueError(f"last_action must have shape {shape}, got {tuple(given.shape)}")
            last = given.to(dtype=self.dtype, device=self.device)
            return lambda: last
        if previous is None:
            return None
        return lambda: previous.last_action.to(dtype=self.dtype, device=self.device)

    def _per_step(self, value: Tensor, name: str) -> Tensor:
        return fit_steps(value, name, self.batch, self.horizon).to(dtype=self.dtype, device=self.device)


def _describe_rest(progress: Progress, violation: Tensor | None, pause: Pause | None) -> dict[str, Tensor]:
    """Returns the diagnostics that a plan has only with constraints, gradient steps or discrete actions."""
    info: dict[str, Tensor] = {}
    if violation is not None:
        info["violation"] = violation
    if pause is not None:
        info |= {"gradient_pause": pause.length, "gradient_wait": pause.left}
    if progress.probabilities is not None:
        info["probabilities"] = progress.probabilities
    return info


def _ignore_nan_actions(candidates: Tensor, scores: Scores) -> Scores:
    """Returns the scores with the return NaN where a candidate is not finite, so that it is never an elite.

    A policy may propose NaN, and a model may give such a sequence a finite return.
    """
    is_finite = torch.isfinite(candidates).flatten(2).all(dim=2)
    return scores._replace(returns=scores.returns.masked_fill(~is_finite, float("nan")))
