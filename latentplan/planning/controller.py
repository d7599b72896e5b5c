"""Receding-horizon control: plan, execute the first actions, shift the plan, plan again."""

from __future__ import annotations

import contextlib
import inspect
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_map

from latentplan.planning.adapters import CEMTrajectoryOptimizer, RolloutController
from latentplan.planning.model import Model, State, check_shape, count_rows, state_device, takes
from latentplan.planning.objectives import Constraint, Term
from latentplan.planning.plan import Iteration, Plan
from latentplan.planning.search.registry import Planner
from latentplan.planning.search.sampling import Generators


class ModelPredictiveController:
    """Acts by planning at every step, or every few steps, and passes each plan to the next search.

    With a `CEMTrajectoryOptimizer` and a rollout function as arguments, the class makes a `RolloutController`.

    Args:
        planner: The planner.
        model: The model in which the planner searches.
        objective: Maximised; see `CEMPlanner.plan`.
        constraints: Violations that plans must avoid.
        generator: One random stream, or a list with one per environment.
        replan_every: Number of actions executed from each plan; at most the planner's horizon.
        keep: See `CEMPlanner.plan`; the candidates of the last search are in `plan.candidates`. A planner whose `plan`
            does not take this argument keeps nothing.
        callback: See `CEMPlanner.plan`.

    Attributes:
        plan: The plans in use; None before the first action and after a reset.

    Raises:
        ValueError: `replan_every` does not lie in 1 to the horizon.
    """

    def __new__(cls, *args: Any, **kwargs: Any) -> Any:
        """Makes a controller for a planner and a model, or for an optimizer and a rollout function."""
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
        keep: str | None = None,
        callback: Callable[[Iteration], Any] | None = None,
    ) -> None:
        horizon = min(planner.horizon, planner.goal_horizon or planner.horizon)
        if replan_every % 1 or not 1 <= replan_every <= horizon:
            raise ValueError(f"replan_every ({replan_every}) must be a whole number in 1 to the horizon ({horizon})")
        self.planner = planner
        self.model = model
        self.objective = objective
        self.constraints = constraints
        self.generator = generator
        self.replan_every = replan_every
        self.keep = keep
        self.callback = callback
        self.plan: Plan | None = None
        self._is_stale: Tensor | None = None  # environments whose plan was made for another objective, (batch,) bool
        self._latencies_ms: deque[float] = deque(maxlen=10_000)

    def act(self, state: State, last_action: Tensor | None = None) -> Tensor:
        """Returns the next action of each environment, (batch, action).

        Args:
            state: Present state of each environment, rows (batch,).
            last_action: The action executed last, (batch, action), if it was another than the controller's.
        """
        return self._act(state, self.generator, last_action)

    def act_where(self, state: State, where: Tensor, last_action: Tensor | None = None) -> Tensor:
        """Returns the next action of some environments; in the others another agent acts, and their plans age.

        Args:
            state: Present state of each environment, rows (batch,).
            where: Environments to decide for, (batch,) bool.
            last_action: The action executed last in each environment, (batch, action), NaN where there is none; None
                takes it from the previous plans, which know it where this controller decided last.

        Returns:
            Actions of the environments in `where`, in order: (chosen, action).

        Raises:
            TypeError: `where` is not a tensor.
            ValueError: `where` selects no environment or has another shape, or the objective or the bounds have one
                value for each of all environments.
        """
        check_shape("where", where, (count_rows(state),))
        where = where.to("cpu", torch.bool)
        rows = where.nonzero().squeeze(1)
        if len(rows) == 0:
            raise ValueError("act_where() needs at least one environment, got none; call skip() instead")
        before = self.plan, self._is_stale
        aged = None if self.plan is None or len(self.plan.is_warm) != len(where) else self.plan.aged()
        self.plan = None if aged is None or self.plan is None else self.plan.take(rows)
        stale = None if aged is None else self._is_stale
        self._is_stale = None if stale is None else stale[rows]
        generator = _select_streams(self.generator, where) or self.generator
        try:
            last = None if last_action is None else last_action[rows.to(last_action.device)]
            action = self._act(tree_map(lambda leaf: leaf[rows.to(leaf.device)], state), generator, last)
        except BaseException:
            self.plan, self._is_stale = before
            raise
        assert self.plan is not None
        spread = self.plan.spread(where)
        # After a change of objective the new plans may have another length.
        has_same_length = aged is not None and aged.mean.shape == spread.mean.shape
        self.plan = aged.updated(where, spread) if aged is not None and has_same_length else spread
        self._is_stale = None if stale is None else stale & ~where
        return action

    def skip(self) -> None:
        """Ages the plan by one step; call this method when another agent acts in every environment."""
        if self.plan is not None:
            self.plan = self.plan.aged()

    def next_actions(self) -> tuple[Tensor, Tensor] | None:
        """Returns the next action of the present plans, (batch, action), and where it is valid, (batch,) bool.

        The action is not valid where the plan has no actions left or was made for another objective. The result is None
        if there is no plan.
        """
        if self.plan is None:
            return None
        batch, horizon = self.plan.actions.shape[:2]
        index = self.plan.elapsed.clamp_max(horizon - 1)
        is_left = self.plan.is_warm & (self.plan.elapsed < horizon) & ~self._find_stale()
        return self.plan.actions[torch.arange(batch, device="cpu"), index], is_left

    def reset(self, mask: Tensor | None = None) -> None:
        """Forgets the plan, so that the next search starts cold.

        Args:
            mask: Environments in which an episode begins, (batch,) bool; None is all of them.

        Raises:
            TypeError: `mask` is not a tensor.
            ValueError: There is a plan, and `mask` does not have one value for each of its environments.
        """
        if mask is None:
            self.plan = None
        elif self.plan is not None:
            self.plan = self.plan.forget(mask)

    def set_objective(self, objective: Term | None, constraints: Sequence[Constraint] | None = None) -> None:
        """Changes the objective, from the next action on; the next search still starts from the previous plan.

        Args:
            objective: Maximised; None is predicted reward and value.
            constraints: Violations that plans must avoid; None leaves the constraints as they are.
        """
        self.objective = objective
        if constraints is not None:
            self.constraints = constraints
        if self.plan is not None:  # no further action of a plan for the old objective is executed
            self._is_stale = torch.ones_like(self.plan.is_warm)

    def memory(self) -> dict[str, Any]:
        """A copy of the plans in use: tensors on the CPU, None and plain values; see `set_memory`."""
        stale = None if self._is_stale is None else self._is_stale.clone()
        return {"plan": None if self.plan is None else self.plan.to_dict(), "is_stale": stale}

    def set_memory(self, memory: dict[str, Any], device: torch.device) -> None:
        """Continues with the plans that another controller had in use, as `memory` returned them.

        Args:
            memory: The plans.
            device: Device of the plans' actions.
        """
        self.plan = None if memory["plan"] is None else Plan.from_dict(memory["plan"], device)
        self._is_stale = memory["is_stale"]

    @property
    def source(self) -> str:
        """Where the first environment's last action came from, see `Plan.source`; "plan" before the first action."""
        return "plan" if self.plan is None else self.plan.source

    @property
    def latency(self) -> dict[str, float]:
        """Milliseconds from state to action over the last 10,000 decisions: `mean_ms`, `p50_ms`, `p95_ms`, `p99_ms`.

        The dictionary is empty before the first action.
        """
        if not self._latencies_ms:
            return {}
        times = torch.tensor(list(self._latencies_ms), dtype=torch.float64, device="cpu")
        p50, p95, p99 = torch.quantile(times, times.new_tensor([0.5, 0.95, 0.99])).tolist()
        return {"mean_ms": float(times.mean()), "p50_ms": p50, "p95_ms": p95, "p99_ms": p99}

    def _act(self, state: State, generator: Generators, last_action: Tensor | None = None) -> Tensor:
        started = time.perf_counter()
        if self.plan is None or self.plan.mean.shape[0] != count_rows(state):
            self.plan = self._search(state, None, generator, last_action)
            is_due = torch.ones(count_rows(state), dtype=torch.bool, device="cpu")
        else:
            is_due = ~self.plan.is_warm | (self.plan.elapsed >= self.replan_every) | self._find_stale()
            if bool(is_due.all()):
                self.plan = self._search(state, self.plan, generator, last_action)
            elif bool(is_due.any()):
                with _keep_streams(_select_streams(generator, ~is_due), _select_streams(generator, is_due)):
                    self.plan = self.plan.updated(is_due, self._search(state, self.plan, generator, last_action))
        self._is_stale = None
        action = self.plan.actions[torch.arange(len(is_due), device="cpu"), self.plan.elapsed]
        self.plan = self.plan.executed(self.plan.elapsed + 1)
        if state_device(state).type == "cuda":
            torch.cuda.synchronize(state_device(state))
        self._latencies_ms.append(1000 * (time.perf_counter() - started))
        return action

    def _find_stale(self) -> Tensor:
        """Returns the environments whose plan was made for another objective, (batch,) bool."""
        assert self.plan is not None
        return torch.zeros_like(self.plan.is_warm) if self._is_stale is None else self._is_stale

    def _search(self, state: State, previous: Plan | None, generator: Generators, last_action: Tensor | None) -> Plan:
        """Returns a new plan, of which no action has been executed."""
        asked: dict[str, Any] = {"keep": self.keep, "last_action": last_action}
        given = {name: value for name, value in asked.items() if value is not None and takes(self.planner.plan, name)}
        if self.callback is not None:
            given["callback"] = self.callback
        plan = self.planner.plan(
            self.model,
            state,
            previous,
            objective=self.objective,
            constraints=self.constraints,
            generator=generator,
            **given,
        )
        return plan.executed(torch.zeros_like(plan.elapsed))


# Tools that show signatures would take that of `__new__`.
_own = inspect.signature(ModelPredictiveController.__init__)
ModelPredictiveController.__signature__ = _own.replace(parameters=list(_own.parameters.values())[1:])  # type: ignore[attr-defined]


@contextlib.contextmanager
def _keep_streams(waiting: list[torch.Generator], due: list[torch.Generator]) -> Iterator[None]:
    """Restores the random streams of environments that keep their plan, so that only replanned ones draw numbers.

    Args:
        waiting: Streams of environments that keep their plan; a stream that is also in `due` is not restored.
        due: Streams of environments that are replanned.
    """
    states = [(stream, stream.get_state()) for stream in waiting if all(stream is not other for other in due)]
    try:
        yield
    finally:
        for stream, state in states:
            stream.set_state(state)


def _select_streams(generators: Generators, where: Tensor) -> list[torch.Generator]:
    """Returns the streams of the environments in where (batch,) bool; none if all environments share one stream."""
    if generators is None or isinstance(generators, torch.Generator):
        return []
    return [generators[row] for row in where.nonzero().squeeze(1).tolist()]
