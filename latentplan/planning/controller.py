"""Receding-horizon control: plan, execute the first actions, shift, plan again."""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_map

from latentplan.planning.adapters import CEMTrajectoryOptimizer, RolloutController
from latentplan.planning.model import Model, State, count_rows, state_device
from latentplan.planning.objectives import Constraint, Term
from latentplan.planning.plan import Plan
from latentplan.planning.search.registry import Planner
from latentplan.planning.search.sampling import Generators


class ModelPredictiveController:
    """Acts by planning anew at every step, or every few, and hands each plan on to the next search.

    With a `CEMTrajectoryOptimizer` and a rollout function in place of planner and model, it is a `RolloutController`.

    Args:
        planner: What searches.
        model: What it searches in.
        objective: What is maximised; see `CEMPlanner.plan`.
        constraints: What plans must keep.
        generator: Random stream, or one per environment.
        replan_every: Actions executed from each plan; at most the planner's horizon.

    Raises:
        ValueError: `replan_every` does not lie in 1 to the horizon.
    """

    def __new__(cls, *args: Any, **kwargs: Any) -> Any:
        """A controller for what it is given: a planner and a model, or an optimizer and a rollout function."""
        if "optimizer" in kwargs or (args and isinstance(args[0], CEMTrajectoryOptimizer)):
            return RolloutController(*args, **kwargs)
        return super().__new__(cls)

    def __init__(
        self,
        planner: Planner,
        model: Model,
        *,
        objective: Term | None = None,
        constraints: Sequence[Constraint] = (),
        generator: Generators = None,
        replan_every: int = 1,
    ) -> None:
        horizon = min(planner.horizon, planner.goal_horizon or planner.horizon)
        if not 1 <= replan_every <= horizon:
            raise ValueError(f"replan_every ({replan_every}) must lie in 1 to the horizon ({horizon})")
        self.planner = planner
        self.model = model
        self.objective = objective
        self.constraints = constraints
        self.generator = generator
        self.replan_every = replan_every
        self.plan: Plan | None = None
        self._is_stale: Tensor | None = None  # whose plans were made for another objective, (batch,) bool
        self._latencies_ms: deque[float] = deque(maxlen=10_000)

    def act(self, state: State) -> Tensor:
        """The next action from each state, (batch, action).

        Args:
            state: Where each environment is now, rows (batch,).
        """
        return self._act(state, self.generator)

    def act_where(self, state: State, where: Tensor) -> Tensor:
        """The next action where it is asked for; elsewhere somebody else acts, and the plans age by that step.

        Args:
            state: Where each environment is now, rows (batch,).
            where: Environments to decide for, (batch,) bool.

        Returns:
            Actions of the environments in `where`, in order: (chosen, action).

        Raises:
            ValueError: There is no environment in `where`, or the objective has goals for all of them, one each.
        """
        where = where.to("cpu", torch.bool)
        rows = where.nonzero().squeeze(1)
        if len(rows) == 0:
            raise ValueError("act_where() needs at least one environment; skip() lets others act everywhere")
        before = self.plan, self._is_stale
        whole = None if self.plan is None or len(self.plan.is_warm) != len(where) else self.plan.aged()
        self.plan = None if whole is None or self.plan is None else self.plan.take(rows)
        stale = None if whole is None else self._is_stale
        self._is_stale = None if stale is None else stale[rows]
        generator = _streams_of(self.generator, where) or self.generator
        try:
            action = self._act(tree_map(lambda leaf: leaf[rows.to(leaf.device)], state), generator)
        except BaseException:
            self.plan, self._is_stale = before
            raise
        assert self.plan is not None
        spread = self.plan.spread(where)
        is_alike = whole is not None and whole.mean.shape == spread.mean.shape  # else it was for another objective
        self.plan = whole.updated(where, spread) if whole is not None and is_alike else spread
        self._is_stale = None if stale is None else stale & ~where
        return action

    def skip(self) -> None:
        """Notes that somebody else acted in every environment: the plan ages by that step."""
        if self.plan is not None:
            self.plan = self.plan.aged()

    def follow(self) -> tuple[Tensor, Tensor] | None:
        """What the present plans would do next, (batch, action), and where they still say it, (batch,) bool.

        None without a plan. Nothing is said by plans that have run out, or were made for another objective.
        """
        if self.plan is None:
            return None
        batch, horizon = self.plan.actions.shape[:2]
        index = self.plan.elapsed.clamp_max(horizon - 1)
        is_left = self.plan.is_warm & (self.plan.elapsed < horizon) & ~self._stale()
        return self.plan.actions[torch.arange(batch), index], is_left

    def _act(self, state: State, generator: Generators) -> Tensor:
        started = time.perf_counter()
        if self.plan is None or self.plan.mean.shape[0] != count_rows(state):
            self.plan = self._search(state, None, generator)
            is_due = torch.ones(count_rows(state), dtype=torch.bool)
        else:
            is_due = ~self.plan.is_warm | (self.plan.elapsed >= self.replan_every) | self._stale()
            if bool(is_due.all()):
                self.plan = self._search(state, self.plan, generator)
            elif bool(is_due.any()):
                with _kept(_streams_of(generator, ~is_due), _streams_of(generator, is_due)):
                    self.plan = self.plan.updated(is_due, self._search(state, self.plan, generator))
        self._is_stale = None
        action = self.plan.actions[torch.arange(len(is_due)), self.plan.elapsed]
        self.plan = self.plan.executed(self.plan.elapsed + 1)
        if state_device(state).type == "cuda":
            torch.cuda.synchronize(state_device(state))
        self._latencies_ms.append(1000 * (time.perf_counter() - started))
        return action

    def reset(self, mask: Tensor | None = None) -> None:
        """Forgets the plan, so that the next search starts cold.

        Args:
            mask: Environments that start anew, (batch,) bool; None is all of them.
        """
        if mask is None:
            self.plan = None
        elif self.plan is not None:
            self.plan = self.plan.forget(mask)

    def set_objective(self, objective: Term | None, constraints: Sequence[Constraint] | None = None) -> None:
        """Changes what is maximised, from the next action on; the last plan stays where the search starts.

        Args:
            objective: What is maximised; None is predicted reward and value.
            constraints: What plans must keep; None leaves them as they are.
        """
        self.objective = objective
        if constraints is not None:
            self.constraints = constraints
        if self.plan is not None:  # what was planned for the old objective is not executed further
            self._is_stale = torch.ones_like(self.plan.is_warm)

    @property
    def source(self) -> str:
        """What the last action is in the first environment: see `Plan.source`; "plan" before the first."""
        return "plan" if self.plan is None else self.plan.source

    @property
    def latency(self) -> dict[str, float]:
        """Milliseconds from state to action over the last 10,000 decisions: `mean_ms`, `p50_ms`, `p95_ms`, `p99_ms`.

        Empty before the first action.
        """
        if not self._latencies_ms:
            return {}
        times = torch.tensor(list(self._latencies_ms), dtype=torch.float64)
        p50, p95, p99 = torch.quantile(times, torch.tensor([0.5, 0.95, 0.99], dtype=torch.float64)).tolist()
        return {"mean_ms": float(times.mean()), "p50_ms": p50, "p95_ms": p95, "p99_ms": p99}

    def _stale(self) -> Tensor:
        assert self.plan is not None
        return torch.zeros_like(self.plan.is_warm) if self._is_stale is None else self._is_stale

    def _search(self, state: State, previous: Plan | None, generator: Generators) -> Plan:
        plan = self.planner.plan(
            self.model,
            state,
            previous,
            objective=self.objective,
            constraints=self.constraints,
            generator=generator,
        )
        return plan.executed(torch.zeros_like(plan.elapsed))


@contextlib.contextmanager
def _kept(waiting: list[torch.Generator], due: list[torch.Generator]) -> Iterator[None]:
    """Leaves the streams of environments whose plans go on where they were, but for those that due ones share."""
    states = [(stream, stream.get_state()) for stream in waiting if all(stream is not other for other in due)]
    try:
        yield
    finally:
        for stream, state in states:
            stream.set_state(state)


def _streams_of(generators: Generators, where: Tensor) -> list[torch.Generator]:
    """The streams of some environments, where (batch,) bool; none where all share one."""
    if generators is None or isinstance(generators, torch.Generator):
        return []
    return [generators[row] for row in where.nonzero().squeeze(1).tolist()]
