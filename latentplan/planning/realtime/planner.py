"""A buffer of plans by tick, and a planner that searches in a process or thread beside the control loop."""

from __future__ import annotations

import os
import threading
import weakref
from collections.abc import Sequence
from multiprocessing.context import SpawnProcess
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Any

from torch import Tensor
from torch.utils._pytree import tree_map

from latentplan.planning.model import Model, State, count_rows
from latentplan.planning.objectives import Constraint, Term, check_constraints
from latentplan.planning.plan import Plan
from latentplan.planning.realtime.worker import (
    CLOSING_SECONDS,
    Answer,
    Goals,
    Request,
    drive_process,
    drive_search,
    dump,
    end_worker,
    start_process,
)
from latentplan.planning.search.registry import SupportsPlan

WORKERS = ("process", "thread")


class PlanBuffer:
    """Plans by the tick at which their first action is due. The buffer has no clock and no thread.

    A tick is the index of a decision. The age of a plan at a tick is the tick minus the tick of the plan's first
    action, and it is also the index of the action that is taken. The age decides the source of an action:

        0 to fresh_ticks            "plan": no newer plan was expected yet;
        beyond, up to max_age       "tail": the next plan is late;
        beyond max_age or horizon   none: the plan is stale and dropped.

    Until the first tick of a plan, the plan before is used.

    Attributes:
        max_age: Largest age at which a plan is used; None uses a plan to its end.
        fresh_ticks: Number of ticks after which the next plan normally arrives; may be changed at any time.

    Raises:
        ValueError: An argument is negative.
    """

    def __init__(self, max_age: int | None = None, fresh_ticks: int = 1) -> None:
        for name, value in (("max_age", max_age), ("fresh_ticks", fresh_ticks)):
            if value is not None and value < 0:
                raise ValueError(f"{name} must be at least 0, got {value}")
        self.max_age, self.fresh_ticks = max_age, fresh_ticks
        self._plans: list[tuple[int, Tensor]] = []  # by first tick, the newest last

    def submit(self, plan_actions: Tensor, first_tick: int) -> None:
        """Adds a plan; a plan for an earlier tick than the newest one is dropped.

        Args:
            plan_actions: Actions of the plan, (..., horizon, action).
            first_tick: Tick of the first action.
        """
        if self._plans and first_tick < self._plans[-1][0]:
            return
        self._plans = [plan for plan in self._plans if plan[0] != first_tick] + [(first_tick, plan_actions)]

    def choose(self, tick: int) -> tuple[Tensor | None, str | None, int | None]:
        """Returns the action (..., action) of a tick, its source ("plan" or "tail") and its age; or three None.

        Ticks must not decrease, because plans that are stale at this tick, or older than the plan in use, are dropped.
        """
        found = self._find(tick)
        if found is None:
            self._plans = [plan for plan in self._plans if plan[0] > tick]
            return None, None, None
        self._plans = self._plans[found:]
        action, age = self._action(found=0, tick=tick)
        return action, "plan" if age <= self.fresh_ticks else "tail", age

    def peek(self, tick: int) -> tuple[Tensor, int] | None:
        """Returns the action (..., action) of the present plans at a later tick, and its age; None without a plan."""
        found = self._find(tick)
        return None if found is None else self._action(found, tick)

    def remaining(self, tick: int) -> Tensor | None:
        """Returns the actions (..., ticks, action) of the plan in use from this tick on; None without a plan."""
        found = self._find(tick)
        if found is None:
            return None
        first_tick, actions = self._plans[found]
        return actions[..., tick - first_tick :, :]

    def clear(self) -> None:
        """Drops every plan."""
        self._plans = []

    def _find(self, tick: int) -> int | None:
        """Returns the index of the newest plan that is due; None if there is none or it is stale."""
        due = [index for index, (first_tick, _) in enumerate(self._plans) if first_tick <= tick]
        if not due:
            return None
        first_tick, actions = self._plans[due[-1]]
        limit = actions.shape[-2] - 1 if self.max_age is None else min(self.max_age, actions.shape[-2] - 1)
        return due[-1] if tick - first_tick <= limit else None

    def _action(self, found: int, tick: int) -> tuple[Tensor, int]:
        first_tick, actions = self._plans[found]
        return actions[..., tick - first_tick, :], tick - first_tick


class BackgroundPlanner:
    """Searches in a process (or thread) of its own, so that the control loop never waits for a plan.

    Except for `close` and `wait_until_ready`, no call takes longer than copying a state. The process is spawned, so the
    script needs `if __name__ == "__main__":`, and planner, model, objective and constraints must be picklable. Use a
    thread for a model on a GPU. A thread shares the interpreter with the loop, and a thread that hangs ends only with
    the program.

    Args:
        planner: The planner; only its method `plan` is called.
        model: The model in which the planner searches; a process works with a copy, made by this call.
        objective: See `CEMPlanner.plan`.
        constraints: See `CEMPlanner.plan`.
        worker: `process` or `thread`.

    Attributes:
        objective: The objective of the next request.
        constraints: The constraints of the next request.

    Raises:
        ValueError: `worker` has another value.
        TypeError: Planner, model, objective or constraints cannot be pickled, or the constraints are no sequence of
            functions.
    """

    def __init__(
        self,
        planner: SupportsPlan,
        model: Model,
        *,
        objective: Term | None = None,
        constraints: Sequence[Constraint] = (),
        worker: str = "process",
    ) -> None:
        if worker not in WORKERS:
            raise ValueError(f"worker must be one of {', '.join(WORKERS)}, got {worker!r}")
        check_constraints(constraints)
        self.objective, self.constraints = objective, tuple(constraints)
        problem = (planner, model, self.objective, self.constraints)
        self._goals: Goals | bytes | None = None  # sent with the next request
        self._sent: Goals | bytes | None = None  # with the last request
        self._is_idle, self._is_closed = True, False
        self._ready = threading.Event()
        self._requests: SimpleQueue[Request | None] = SimpleQueue()
        self._answers: SimpleQueue[Answer] = SimpleQueue()
        self.process: SpawnProcess | None = None
        channels = (self._requests, self._answers, self._ready)
        if worker == "process":
            self.process, connection = start_process()
            arguments: tuple[Any, ...] = (connection, dump(problem), *channels)
        else:
            arguments = (problem, *channels)
        target = drive_process if worker == "process" else drive_search
        self._thread = threading.Thread(target=target, args=arguments, name="latentplan-plan", daemon=True)
        self._thread.start()
        # The thread holds no reference to this object, so the finalizer runs when the object is dropped or at exit.
        self._close = weakref.finalize(self, end_worker, os.getpid(), self._requests, self._thread, self.process)

    @property
    def is_idle(self) -> bool:
        """Whether a request would be accepted now: no search is running, and no result is left to poll."""
        return self._is_idle and not self._is_closed

    def wait_until_ready(self, seconds: float) -> bool:
        """Waits up to `seconds` for the worker; returns whether the worker is ready or has failed to start."""
        return self._ready.wait(seconds)

    def set_objective(self, objective: Term | None = None, constraints: Sequence[Constraint] = ()) -> None:
        """Changes objective and constraints, from the next request on.

        Args:
            objective: See `CEMPlanner.plan`.
            constraints: See `CEMPlanner.plan`.

        Raises:
            TypeError: The objective or a constraint cannot be pickled, or the constraints are no sequence of functions;
                the old ones stay.
        """
        check_constraints(constraints)
        goals = (objective, tuple(constraints))
        self._goals = goals if self.process is None else dump(goals)
        self.objective, self.constraints = goals

    def request(self, state: State, tick: int, previous: Plan | None = None, seed: int | None = None) -> bool:
        """Starts the search of a plan whose first action is due at `tick`; see `PlanExecutor.request`."""
        if not self.is_idle:
            return False
        count_rows(state)  # refuses what is no state, and makes dataclasses in it pytrees
        copied = tree_map(lambda leaf: leaf.detach().clone(), state)
        self._is_idle = False
        self._sent, self._goals = self._goals, None
        self._requests.put(Request(copied, tick, previous, seed, self._sent))
        return True

    def poll(self) -> tuple[int, Plan] | None:
        """Returns the finished plan with the tick of its request, once; None if no plan is finished.

        Raises:
            Exception: The exception that the search raised, with its type and message; the cause has its traceback.
            RuntimeError: The process has ended unexpectedly, and no more plans will come.
        """
        try:
            kind, value = self._answers.get_nowait()
        except Empty:
            return None
        if self._is_closed:
            return None
        if kind == "ended":
            assert self.process is not None
            self.process.join(CLOSING_SECONDS)
            self.close()
            code = self.process.exitcode
            is_unguarded = code == 1 and not value  # whether the worker had started
            hint = '; a script that plans in a process needs `if __name__ == "__main__":`' if is_unguarded else ""
            raise RuntimeError(f"the process that plans has ended unexpectedly (exit code {code}){hint}")
        self._is_idle = True
        if kind == "error":
            if self._goals is None:  # the request may not have reached the search
                self._goals = self._sent
            error, traceback = value
            raise error from RuntimeError(f"in the worker that plans:\n{traceback}")
        finished: tuple[int, Plan] = value
        return finished

    def close(self) -> None:
        """Ends the worker, even during a search; may be called again."""
        self._is_closed = True
        self._close()

    def __enter__(self) -> BackgroundPlanner:
        """Returns the planner."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        """Closes the planner."""
        self.close()
