"""Planning beside a control loop: which plans to request, and which action each tick takes."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor
from torch.utils._pytree import tree_map

from latentplan.planning.model import (
    Model,
    State,
    action_dtype,
    count_rows,
    is_sampling,
    state_device,
    supports,
    take_step,
)
from latentplan.planning.objectives import Constraint, Term, apply_view
from latentplan.planning.plan import Plan
from latentplan.planning.realtime.planner import PlanBuffer
from latentplan.planning.search.choices import Choices, read_choices
from latentplan.planning.search.problem import find_max_change, split_limits
from latentplan.planning.search.registry import Planner
from latentplan.planning.search.space import Bounds, read_bounds

NUM_LATENCIES = 16


class PlanExecutor(Protocol):
    """An object that computes plans, one at a time, while decisions go on. No method may wait for a plan."""

    @property
    def is_idle(self) -> bool:
        """Whether a request would be accepted now: ready, no search running, no result left to poll."""
        ...

    def request(self, state: State, tick: int, previous: Plan | None = None, seed: int | None = None) -> bool:
        """Starts the search of a plan whose first action is due at `tick`.

        Args:
            state: The state predicted for `tick`, rows (batch,).
            tick: Returned with the plan.
            previous: Previous plan for a warm start, with `elapsed` set for `tick`.
            seed: Seed of the search's random stream; None takes torch's default.

        Returns:
            Whether the request was accepted; an executor that is not idle ignores requests.
        """
        ...

    def set_objective(self, objective: Term | None = None, constraints: Sequence[Constraint] = ()) -> None:
        """Changes objective and constraints from the next request on; see `CEMPlanner.plan`."""
        ...

    def poll(self) -> tuple[int, Plan] | None:
        """Returns the finished plan with the tick of its request, once; None if no plan is finished.

        Raises:
            Exception: The exception that the search raised; the executor is idle again.
        """
        ...


class Decision(NamedTuple):
    """The decision of a tick.

    Attributes:
        action: The action of each environment, (batch, action).
        source: Source of the action: "plan", "tail" (the plan after the next one was expected) or "actor". A plan also
            counts where the policy acts for some environments, because the search found nothing for them.
        age: Age of the plan in ticks; None for an action of the actor.
    """

    action: Tensor
    source: str
    age: int | None


class PlanScheduler:
    """Chooses the action of each tick from the newest plan, and requests plans from an executor.

    The scheduler counts ticks and has no clock, thread or process. The caller calls `decide(state)` once for every
    executed decision, in order. `decide`

        1. polls the executor, and puts a finished plan into the buffer at the tick of its request;
        2. takes this tick's action from the buffer, corrected by the policy if the model has one (see
           `NominalTrajectory`), which acts alone in environments for which the search found nothing; without a plan it
           takes the policy's action, or the middle of the bounds without a policy;
        3. requests the next plan if the executor is idle: it predicts how many ticks the search takes, steps the model
           by the actions of these ticks (this action, then the buffer's, then the policy's), and requests a plan from
           that state, warm-started from the last plan shifted to the same tick.

    The predicted latency is the upper quartile of the last 16 latencies. A latency is the number of ticks from the
    request to the decision that finds the plan. The first latency does not count, because it includes lazy
    initialisation. A plan that arrives early waits until its tick; of a plan that arrives late, the first actions are
    skipped.

    `BackgroundPlanner` is an executor in real time. An executor on a virtual clock computes the plan in `request` and
    measures the duration; its `poll` returns the plan once the virtual time has reached the time of the request plus
    the duration, and `is_idle` is true after that. The caller advances the virtual time between calls of `decide`.

    Args:
        planner: Planner of the executor; only its horizon and action bounds are read.
        model: Predicts states; its `policy`, if any, acts where there is no plan, and corrects planned actions.
        executor: Computes plans. Where it has the attributes `objective` and `constraints`, the scheduler follows
            them: a change of the executor's goals counts as a call of `set_objective`.
        max_age: See `PlanBuffer`.
        fresh_ticks: See `PlanBuffer`; None follows the predicted latency.
        generator: Draws the seed of each request, and at first the seed of the stream of a model that samples; None
            leaves the seeds to the executor and the model.
    """

    def __init__(
        self,
        planner: Planner,
        model: Model,
        executor: PlanExecutor,
        *,
        max_age: int | None = None,
        fresh_ticks: int | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        self.planner, self.model, self.executor, self.generator = planner, model, executor, generator
        self._stream: torch.Generator | None = None  # of a model that samples
        if generator is not None and is_sampling(model):
            self._stream = torch.Generator(generator.device).manual_seed(self._draw_seed(generator))
        self.buffer = PlanBuffer(max_age, 1 if fresh_ticks is None else fresh_ticks)
        self.tick = 0  # of the next decision; never reset, so that a late plan is not mistaken for a newer plan
        self._follows_latency = fresh_ticks is None
        self._latencies: deque[int] = deque(maxlen=NUM_LATENCIES)
        self._is_warmed_up = False
        # Of the running request: the tick at which it was made, and tick and state of the plan's start.
        self._requested: tuple[int, int, State] | None = None
        self._nominals: dict[int, NominalTrajectory] = {}  # by the tick of the plan's first action
        self._failures: dict[int, Tensor] = {}  # by the same tick: environments without a search, (batch,) bool
        self._last: tuple[int, Plan] | None = None
        self._batch: int | None = None
        self._action: Tensor | None = None  # of the last tick, (batch, action)
        self._follow(*self._find_goals(None, ()))

    @property
    def latency_ticks(self) -> int:
        """Expected number of ticks until the next plan is finished, 1 to the horizon."""
        if not self._latencies:
            return 1
        expected = sorted(self._latencies)[3 * len(self._latencies) // 4]
        return min(expected, self.planner.horizon)

    @torch.no_grad()
    def decide(self, state: State) -> Decision:
        """Returns the decision of this tick, and requests a plan for a later tick.

        Where the policy acts and its action is NaN, the decision is NaN: the caller knows what is safe.

        Args:
            state: Believed state of each environment, rows (batch,); a change of the number of rows drops all plans.

        Raises:
            Exception: The exception that a search in the executor raised; the next call continues.
        """
        if count_rows(state) != self._batch:  # the plans are for other environments
            self.reset()
            self._batch = count_rows(state)
        objective, constraints = self._find_goals(*self._goals)
        if objective is not self._goals[0] or constraints is not self._goals[1]:
            self._follow(objective, constraints)
        self._collect()
        action, source, age = self.buffer.choose(self.tick)
        if age is None or source is None:
            action, source = self._act_by_policy(state), "actor"
        else:
            action = self._act_by_plan(state, self.tick, age)
        self._action = action = self._limit_change(action, state, age or 0)
        if self.executor.is_idle:
            self._request(state, action)
        self.tick += 1
        return Decision(action.clone(), source, age)  # the caller may change it, and plans may hold the action

    def set_objective(self, objective: Term | None = None, constraints: Sequence[Constraint] = ()) -> None:
        """Changes the objective and constraints of the next requests; earlier plans are used until new ones arrive.

        For a learned goal (`conditioned`) the goal's policy acts where there is no plan. Rate limits hold from the next
        decision on.
        """
        self.executor.set_objective(objective, constraints)
        self._follow(*self._find_goals(objective, constraints))

    def reset(self, mask: Tensor | None = None) -> None:
        """Drops all plans, and the plan of the running request when it arrives.

        Args:
            mask: Environments whose next action may differ from the last one by any amount, bool (batch,); rate limits
                hold on in the others. None stands for all environments.
        """
        last = self._action
        self.buffer.clear()
        self._nominals, self._failures = {}, {}
        self._requested = self._last = self._action = None
        if mask is not None and last is not None:
            self._action = torch.where(mask.to(last.device)[:, None], torch.nan, last)

    def _find_goals(
        self, objective: Term | None, constraints: Sequence[Constraint]
    ) -> tuple[Term | None, Sequence[Constraint]]:
        """Returns the executor's objective and constraints; the given ones where the executor does not tell its own."""
        return getattr(self.executor, "objective", objective), getattr(self.executor, "constraints", constraints)

    def _follow(self, objective: Term | None, constraints: Sequence[Constraint]) -> None:
        """Finds the rate limits of the next decisions, and the model or view whose policy acts."""
        self._limits, _ = split_limits(constraints)  # each (1,) or (action,)
        self._acting: Any = apply_view(self.model, objective)[0]
        self._goals = objective, constraints

    def _collect(self) -> None:
        """Puts a finished plan, if there is one, into the buffer."""
        try:
            finished = self.executor.poll()
        except Exception:
            self._requested = None
            raise
        if finished is None:
            return
        requested, self._requested = self._requested, None
        tick, plan = finished
        if self._is_warmed_up and requested is not None:
            self._latencies.append(self.tick - requested[0])
        self._is_warmed_up = True
        if requested is None or requested[1] != tick:  # the request was made before a reset
            return
        plan.warn_of_failures()
        failures = plan.info["is_fallback"]
        if bool(failures.all()):  # without a search, the policy in the real state is the better choice
            return
        self.buffer.submit(plan.actions, tick)
        now, nominals = self.tick, self._nominals.items()
        self._nominals = {first: nominal for first, nominal in nominals if now - first < nominal.actions.shape[1]}
        self._nominals[tick] = NominalTrajectory(self.model, requested[2], plan.actions, self._stream)
        self._failures = {first: failed for first, failed in self._failures.items() if first in self._nominals}
        if bool(failures.any()):
            self._failures[tick] = failures.to(plan.actions.device)
        self._last = finished
        if self._follows_latency:
            self.buffer.fresh_ticks = self.latency_ticks

    def _request(self, state: State, action: Tensor) -> None:
        """Requests the next plan, given the state and the action of this tick."""
        due = self.tick + self.latency_ticks
        if self._last is not None:
            due = max(due, self._last[0] + 1)  # each plan starts at a later tick than the last
        for tick in range(self.tick + 1, due + 1):
            state, _ = take_step(self.model, state, action, self._stream)
            if tick < due:
                planned = self.buffer.peek(tick)
                action = self._act_by_policy(state) if planned is None else self._act_by_plan(state, tick, planned[1])
        seed = None if self.generator is None else self._draw_seed(self.generator)
        if self.executor.request(state, due, self._warm_start(due), seed):
            self._requested = (self.tick, due, state)

    @staticmethod
    def _draw_seed(generator: torch.Generator) -> int:
        return int(torch.randint(2**62, (1,), generator=generator, device=generator.device))

    def _warm_start(self, due: int) -> Plan | None:
        if self._last is None or due - self._last[0] >= self._last[1].mean.shape[1]:
            return None
        first_tick, plan = self._last
        return plan.executed(torch.full_like(plan.elapsed, due - first_tick))

    def _act_by_plan(self, state: State, tick: int, age: int) -> Tensor:
        """Returns the action (batch, action) of the plan that has this age at a tick, corrected by the policy.

        In environments for which the search found nothing, the policy acts.
        """
        nominal, failures = self._nominals[tick - age], self._failures.get(tick - age)
        planned = nominal.actions[:, age]
        if not supports(self._acting, "policy"):
            return planned
        if getattr(self.planner, "action_choices", None) is None:  # a discrete action plus a correction is no action
            planned = self._bounds(state, age).fit_step(nominal.correct(age, state, self._act_by_policy), 0)
        return planned if failures is None else torch.where(failures[:, None], self._act_by_policy(state), planned)

    def _act_by_policy(self, state: State) -> Tensor:
        """Returns the policy's mode, or the middle of the bounds without a policy, (rows, action).

        The rows may hold the batch several times, one copy after the other.
        """
        bounds = self._bounds(state)
        if supports(self._acting, "policy"):
            return bounds.fit_step(self._acting.policy(state, None), 0)
        return bounds.fit_step(((bounds.low + bounds.high) / 2)[:, 0].expand(count_rows(state), -1), 0)

    def _limit_change(self, action: Tensor, state: State, step: int) -> Tensor:
        """Returns the action, near the last one if there are rate limits; the bounds of its step prevail over them."""
        if not self._limits or self._action is None:
            return action
        bounds, last = self._bounds(state, step), self._action
        largest = find_max_change(self._limits, bounds)
        near = torch.clamp(action, last - largest, last + largest)
        return torch.clamp(torch.where(torch.isnan(last), action, near), bounds.low[:, 0], bounds.high[:, 0])

    def _bounds(self, state: State, step: int = 0) -> Bounds:
        """Returns the bounds of a step of a plan, (1 or rows, 1, action), and its discrete dimensions.

        Rows that hold the batch several times, one copy after the other, have the bounds as often.
        """
        planner, dtype, device = self.planner, action_dtype(state), state_device(state)
        values = read_choices(getattr(planner, "action_choices", None), planner.action_dim)
        bounds = read_bounds(planner.action_low, planner.action_high, planner.action_dim, values)
        low, high = (bound[:, [min(step, bound.shape[1] - 1)]].to(device, dtype) for bound in bounds)
        copies = count_rows(state) // max(len(low), len(high)) if max(len(low), len(high)) > 1 else 1
        low, high = (bound.repeat(copies, 1, 1) if len(bound) > 1 else bound for bound in (low, high))
        return Bounds(low, high, Choices(values, dtype, device) if values else None)


class NominalTrajectory:
    """The states that a plan predicts; the model computes each of them at its first use.

    A plan is made for a predicted state and executed in the real state. The policy corrects the planned action by
    feedback: `u = u_plan + pi(x) - pi(x_plan)`, with the real state x and the predicted state x_plan. The correction is
    0 where the prediction was right. In optimal control the feedback law pi is linear (Tassa et al. 2012, "Synthesis
    and stabilization of complex behaviors through online trajectory optimization", equation 8).

    Args:
        model: The model that predicts the states.
        start: Start of the plan, rows (batch,).
        actions: The plan, (batch, horizon, action).
        generator: Random stream of a model that samples; None leaves the stream to the model.
    """

    def __init__(self, model: Model, start: State, actions: Tensor, generator: torch.Generator | None = None) -> None:
        self.model, self.actions, self._generator = model, actions, generator
        self._states = [start]

    def state_at(self, age: int) -> State:
        """Returns the predicted state after `age` actions of the plan, rows (batch,)."""
        while len(self._states) <= age:
            action = self.actions[:, len(self._states) - 1]
            following, _ = take_step(self.model, self._states[-1], action, self._generator)
            self._states.append(following)
        return self._states[age]

    def correct(self, age: int, state: State, policy: Callable[[State], Tensor]) -> Tensor:
        """Returns the plan's action of this age with the policy's correction, (batch, action).

        Args:
            age: Index of the action in the plan.
            state: Real state of each environment, as believed, rows (batch,).
            policy: Returns the policy's mode (rows, action).

        Returns:
            Actions, which the caller clamps into the bounds; the plan's own where the policy is not finite.
        """
        both = tree_map(lambda real, predicted: torch.cat([real, predicted]), state, self.state_at(age))
        in_real, in_predicted = policy(both).chunk(2)
        correction = in_real - in_predicted
        return self.actions[:, age] + torch.where(torch.isfinite(correction), correction, 0.0)
