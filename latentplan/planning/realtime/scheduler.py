"""Planning beside a control loop that does not wait: what to ask for, when it is usable, which action a tick takes."""

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
    per_dimension,
    state_device,
    supports,
    take_step,
)
from latentplan.planning.objectives import Constraint, Term, seen_for
from latentplan.planning.plan import Plan
from latentplan.planning.realtime.planner import PlanBuffer
from latentplan.planning.search.registry import Planner

NUM_LATENCIES = 16


class PlanExecutor(Protocol):
    """Whoever computes plans, one at a time, while decisions go on. None of these calls may wait for a plan."""

    @property
    def is_idle(self) -> bool:
        """Whether a request would be taken now: ready, nothing in work, no result left to poll."""
        ...

    def request(self, state: State, tick: int, previous: Plan | None = None, seed: int | None = None) -> bool:
        """Start a plan whose first action is due at `tick`; False (and nothing happens) when not idle.

        Args:
            state: Where the plan starts: the state predicted for `tick`, rows (batch,).
            tick: Handed back with the plan.
            previous: Warm start, already shifted (its `elapsed` says by how much).
            seed: Of the search's random stream; None takes torch's default.
        """
        ...

    def set_objective(self, objective: Term | None = None, constraints: Sequence[Constraint] = ()) -> None:
        """Plan for this from the next request on; see `CEMPlanner.plan`."""
        ...

    def poll(self) -> tuple[int, Plan] | None:
        """The finished plan and the tick of its request, once; None while there is none.

        Raises:
            Exception: What the search raised; the executor is idle again.
        """
        ...


class Decision(NamedTuple):
    """What one tick takes: `action` (batch, action), its `source` ("plan", "tail" or "actor") and the plan's `age`."""

    action: Tensor
    source: str
    age: int | None


class PlanScheduler:
    """The rules of planning beside a control loop, with the executor of plans injected.

    The seam. The scheduler knows ticks only: no clock, thread or process. `decide(state)` is called once for every
    decision that is executed, in order, and

        1. polls the executor, and puts a finished plan into the buffer at the tick it was asked for;
        2. takes this tick's action from the buffer, or from the model's policy (zeros without one) if it has none; an
           action from the buffer gets what the policy does differently here than where the plan expected to be (see
           `NominalTrajectory`; nothing without a policy);
        3. if the executor is idle, asks for the next plan: it predicts how many ticks that takes, rolls the state
           forward by the actions these ticks will take (this one, then the buffer's, then the policy's), and requests
           a plan from there, warm-started from the last one shifted to the same tick.

    The latency is the upper quartile of the last 16, each counted in ticks from the decision that asked to the one that
    found the plan; the first is left out, because it includes lazy initialisation. A plan that comes earlier waits
    until its tick; one that comes later is used from the action that the tick has reached.

    `BackgroundPlanner` executes plans in real time. A simulation injects an executor on a virtual clock: `request`
    computes the plan at once and measures how long that took, `is_idle` is whether the last result has been polled, and
    `poll` gives it once the virtual time has reached that of the request plus the duration. The driver moves the
    virtual time from tick to tick and calls `decide`.

    Args:
        planner: Settings of the search: horizon and action bounds. Only the executor calls it.
        model: Rolls the state forward; its `policy`, if any, acts where there is no plan, and holds to plans.
        executor: What computes plans.
        max_age: See `PlanBuffer`.
        fresh_ticks: See `PlanBuffer`; None follows the predicted latency.
        generator: Gives each request its seed; None leaves it to the executor.
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
        self._acting: Any = model  # whose policy acts
        self.buffer = PlanBuffer(max_age, 1 if fresh_ticks is None else fresh_ticks)
        self.tick = 0  # of the next decision; goes on through resets, so that late plans cannot be mistaken
        self._follows_latency = fresh_ticks is None
        self._latencies: deque[int] = deque(maxlen=NUM_LATENCIES)
        self._is_warmed_up = False
        self._asked: tuple[int, int, State] | None = None  # tick of the request in work, the tick and state it is for
        self._nominals: dict[int, NominalTrajectory] = {}  # by the tick of the plan's first action
        self._last: tuple[int, Plan] | None = None
        self._batch: int | None = None

    @property
    def latency_ticks(self) -> int:
        """Ticks that the next plan is expected to take, 1 to the horizon."""
        if not self._latencies:
            return 1
        expected = sorted(self._latencies)[3 * len(self._latencies) // 4]
        return min(expected, self.planner.horizon)

    @torch.no_grad()
    def decide(self, state: State) -> Decision:
        """The action of this tick, and a request for a later one.

        Args:
            state: Where each environment is believed to be now, rows (batch,); other rows than before forget all plans.

        Raises:
            Exception: What the search in the executor raised; the next call goes on.
        """
        if count_rows(state) != self._batch:  # what was planned is of other environments
            self.reset()
            self._batch = count_rows(state)
        self._collect()
        action, source, age = self.buffer.choose(self.tick)
        if age is None or source is None:
            action, source = self._act_alone(state), "actor"
        else:
            action = self._follow(state, self.tick, age)
        if self.executor.is_idle:
            self._ask(state, action)
        self.tick += 1
        return Decision(action, source, age)

    def set_objective(self, objective: Term | None = None, constraints: Sequence[Constraint] = ()) -> None:
        """Changes what plans asked for from now on pursue; those made before are followed until these come.

        A goal that the model has learned to pursue (`conditioned`) brings the policy that acts where there is no plan.
        """
        self.executor.set_objective(objective, constraints)
        self._acting, _ = seen_for(self.model, objective)

    def reset(self) -> None:
        """Forget all plans, the one in work too: what it was asked for is over."""
        self.buffer.clear()
        self._nominals = {}
        self._asked = self._last = None

    def _collect(self) -> None:
        try:
            finished = self.executor.poll()
        except Exception:
            self._asked = None
            raise
        if finished is None:
            return
        asked, self._asked = self._asked, None
        tick, plan = finished
        if self._is_warmed_up and asked is not None:
            self._latencies.append(self.tick - asked[0])
        self._is_warmed_up = True
        if asked is None or asked[1] != tick:  # asked for before a reset
            return
        plan.warn_of_failures()
        if bool(plan.info["is_fallback"].all()):  # who decides when the time has come knows more than this plan does
            return
        self.buffer.submit(plan.actions, tick)
        now, nominals = self.tick, self._nominals.items()
        self._nominals = {first: nominal for first, nominal in nominals if now - first < nominal.actions.shape[1]}
        self._nominals[tick] = NominalTrajectory(self.model, asked[2], plan.actions)
        self._last = finished
        if self._follows_latency:
            self.buffer.fresh_ticks = self.latency_ticks

    def _ask(self, state: State, action: Tensor) -> None:
        due = self.tick + self.latency_ticks
        if self._last is not None:
            due = max(due, self._last[0] + 1)  # a plan for a tick that already has one would be of no use
        for tick in range(self.tick + 1, due + 1):
            state, _ = take_step(self.model, state, action)
            if tick < due:
                planned = self.buffer.peek(tick)
                action = self._act_alone(state) if planned is None else self._follow(state, tick, planned[1])
        seed = None
        if self.generator is not None:
            device = self.generator.device
            seed = int(torch.randint(2**62, (1,), generator=self.generator, device=device))
        if self.executor.request(state, due, self._warm_start(due), seed):
            self._asked = (self.tick, due, state)

    def _warm_start(self, due: int) -> Plan | None:
        if self._last is None or due - self._last[0] >= self._last[1].mean.shape[1]:
            return None
        first_tick, plan = self._last
        return plan.executed(torch.full_like(plan.elapsed, due - first_tick))

    def _follow(self, state: State, tick: int, age: int) -> Tensor:
        """The action (batch, action) at a tick of the plan that is of this age there, held to it by the policy."""
        nominal = self._nominals[tick - age]
        if not supports(self._acting, "policy"):
            return nominal.actions[:, age]
        return nominal.correct(age, state, self._act_alone).clamp(*self._bounds(state))

    def _act_alone(self, state: State) -> Tensor:
        low, high = self._bounds(state)
        if not supports(self._acting, "policy"):
            return torch.zeros(count_rows(state), len(low), device=low.device, dtype=low.dtype).clamp(low, high)
        return self._acting.policy(state, None).to(low.dtype).clamp(low, high)  # type: ignore[no-any-return]

    def _bounds(self, state: State) -> tuple[Tensor, Tensor]:
        planner, dtype, device = self.planner, action_dtype(state), state_device(state)
        bounds: Any = (planner.action_low, planner.action_high)
        low, high = (per_dimension(bound, planner.action_dim, "bounds").to(device, dtype) for bound in bounds)
        return low, high


class NominalTrajectory:
    """The states that a plan predicts, imagined as far as they are needed.

    A plan is made for a predicted state and executed in another one. The policy is a feedback law: its action in the
    real state minus its action in the predicted state, added to the planned action, answers what the plan could not
    foresee, and is 0 where the model was right. The form is `u = u_plan + pi(x) - pi(x_plan)` of optimal control, there
    with a linear law (Tassa et al. 2012, "Synthesis and stabilization of complex behaviors through online trajectory
    optimization", equation 8).

    Args:
        model: The model that predicts the states.
        start: Start of the plan, rows (batch,).
        actions: The plan, (batch, horizon, action).
    """

    def __init__(self, model: Model, start: State, actions: Tensor) -> None:
        self.model, self.actions = model, actions
        self._states = [start]

    def state_at(self, age: int) -> State:
        """Returns the predicted state after `age` actions of the plan, rows (batch,)."""
        while len(self._states) <= age:
            following, _ = take_step(self.model, self._states[-1], self.actions[:, len(self._states) - 1])
            self._states.append(following)
        return self._states[age]

    def correct(self, age: int, state: State, policy: Callable[[State], Tensor]) -> Tensor:
        """Returns the plan's action of this age with the policy's correction, (batch, action).

        Args:
            age: Index of the action in the plan.
            state: Believed state of each environment, rows (batch,).
            policy: Returns the policy's mode (rows, action).

        Returns:
            Actions, which the caller clamps into the bounds; the plan's own where the policy is not finite.
        """
        both = tree_map(lambda here, there: torch.cat([here, there]), state, self.state_at(age))
        here, there = policy(both).chunk(2)
        answer = here - there
        planned = self.actions[:, age]
        return planned + torch.where(torch.isfinite(answer), answer, 0.0)
