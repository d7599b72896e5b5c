"""Planning in real time: plans by the tick they are for, and a search that runs beside the control loop."""

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

from latentplan.planning.model import Model, State
from latentplan.planning.objectives import Constraint, Term
from latentplan.planning.plan import Plan
from latentplan.planning.realtime.worker import (
    CLOSING_SECONDS,
    Answer,
    Goals,
    Request,
    drive_process,
    drive_search,
    dump,
    end,
    start_process,
)
from latentplan.planning.search.registry import SupportsPlan

WORKERS = ("process", "thread")


class PlanBuffer:
    """Plans by the tick at which their first action is due; pure bookkeeping, no clock and no thread.

    A tick is the index of a decision. The age of a plan at a tick is the tick minus the one its first action is due at,
    and it is also the index of the action that the tick takes. By its age, an action comes from

        0 to fresh_ticks            the "plan": nothing newer was to be expected yet;
        beyond, up to max_age       the "tail" of a plan whose successor is late;
        beyond max_age or horizon   nowhere: the plan is stale and dropped.

    A plan that is not due yet waits while the one before it goes on.

    Attributes:
        max_age: Oldest age at which a plan is used; None uses it to its end.
        fresh_ticks: Ticks after which the next plan normally arrives; may be changed at any time.

    Raises:
        ValueError: A setting is negative.
    """

    def __init__(self, max_age: int | None = None, fresh_ticks: int = 1) -> None:
        for name, value in (("max_age", max_age), ("fresh_ticks", fresh_ticks)):
            if value is not None and value < 0:
                raise ValueError(f"{name} must be at least 0, got {value}")
        self.max_age, self.fresh_ticks = max_age, fresh_ticks
        self._plans: list[tuple[int, Tensor]] = []  # by first tick, the newest last

    def submit(self, plan_actions: Tensor, first_tick: int) -> None:
        """Hold a plan; one that is older than the newest held is dropped.

        Args:
            plan_actions: (..., horizon, action).
            first_tick: Tick of its first action.
        """
        if self._plans and first_tick < self._plans[-1][0]:
            return
        self._plans = [plan for plan in self._plans if plan[0] != first_tick] + [(first_tick, plan_actions)]

    def choose(self, tick: int) -> tuple[Tensor | None, str | None, int | None]:
        """The action (..., action) of a tick, its source ("plan" or "tail") and its age in ticks; else three None.

        Ticks do not go back: plans that are stale at this one, or older than the one in use, are dropped.
        """
        found = self._find(tick)
        if found is None:
            self._plans = [plan for plan in self._plans if plan[0] > tick]
            return None, None, None
        self._plans = self._plans[found:]
        action, age = self._action(found=0, tick=tick)
        return action, "plan" if age <= self.fresh_ticks else "tail", age

    def peek(self, tick: int) -> tuple[Tensor, int] | None:
        """The action (..., action) that a later tick would take, and its age, judged from the plans held now."""
        found = self._find(tick)
        return None if found is None else self._action(found, tick)

    def remaining(self, tick: int) -> Tensor | None:
        """The actions (..., ticks, action) of the plan in use, from this tick to the plan's end."""
        found = self._find(tick)
        if found is None:
            return None
        first_tick, actions = self._plans[found]
        return actions[..., tick - first_tick :, :]

    def clear(self) -> None:
        """Drop every plan."""
        self._plans = []

    def _find(self, tick: int) -> int | None:
        """Index of the newest plan that is due; None when there is none, or it is stale (older ones are staler)."""
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
    """Searches in one process (or thread) of its own, so that the control loop never waits for a plan.

    No call but `close` and `wait_until_ready` takes longer than copying a state. The process is spawned, so a script
    that makes one needs `if __name__ == "__main__":`, and planner, model, objective and constraints must be picklable;
    a model on a GPU is better served by a thread. A thread shares the interpreter with the loop, and one that hangs
    cannot be ended: it is left to end with the program.

    Args:
        planner: What searches, usually a `CEMPlanner`.
        model: What it searches in; a process works with a copy of it, made now.
        objective: See `CEMPlanner.plan`.
        constraints: See `CEMPlanner.plan`.
        worker: `process` or `thread`.

    Raises:
        ValueError: There is no such worker.
        TypeError: Something cannot be sent to another process.
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
        problem = (planner, model, objective, tuple(constraints))
        self._goals: Goals | bytes | None = None  # that the next request carries
        self._is_idle, self._is_closed = True, False
        self._ready = threading.Event()
        self._requests: SimpleQueue[Request | None] = SimpleQueue()
        self._answers: SimpleQueue[Answer] = SimpleQueue()
        self.process: SpawnProcess | None = None
        ends = (self._requests, self._answers, self._ready)
        if worker == "process":
            self.process, connection = start_process()
            arguments: tuple[Any, ...] = (connection, dump(problem), *ends)
        else:
            arguments = (problem, *ends)
        target = drive_process if worker == "process" else drive_search
        self._thread = threading.Thread(target=target, args=arguments, name="latentplan-plan", daemon=True)
        self._thread.start()
        # The thread holds no reference to this object: one that is dropped, or alive at exit, is closed all the same.
        self._close = weakref.finalize(self, end, os.getpid(), self._requests, self._thread, self.process)

    @property
    def is_idle(self) -> bool:
        """Whether a request would be taken now: nothing is in work, and no result is left to poll."""
        return self._is_idle and not self._is_closed

    def wait_until_ready(self, seconds: float) -> bool:
        """Wait until the worker can search at once, at most so long; whether it can (or has failed to start)."""
        return self._ready.wait(seconds)

    def set_objective(self, objective: Term | None = None, constraints: Sequence[Constraint] = ()) -> None:
        """Changes what is searched for, from the next request on.

        Args:
            objective: See `CEMPlanner.plan`.
            constraints: See `CEMPlanner.plan`.

        Raises:
            TypeError: Something cannot be sent to another process; the old goals stay.
        """
        goals = (objective, tuple(constraints))
        self._goals = goals if self.process is None else dump(goals)

    def request(self, state: State, tick: int, previous: Plan | None = None, seed: int | None = None) -> bool:
        """Start the search of a plan whose first action is due at `tick`; False (and nothing happens) if one is busy.

        Args:
            state: Where the plan starts: the state predicted for `tick`, rows (batch,).
            tick: Handed back with the plan.
            previous: Warm start, already shifted (its `elapsed` says by how much).
            seed: Of the search's random stream; None takes torch's default.
        """
        if not self.is_idle:
            return False
        self._is_idle = False
        goals, self._goals = self._goals, None
        own = tree_map(lambda leaf: leaf.detach().clone(), state)
        self._requests.put(Request(own, tick, previous, seed, goals))
        return True

    def poll(self) -> tuple[int, Plan] | None:
        """The finished plan and the tick it was requested for, once; None while there is none.

        Raises:
            Exception: What the search raised, with its own type and message; where it happened is the cause.
            RuntimeError: The process has ended by itself. No more plans come.
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
            hint = '; a script that starts one needs `if __name__ == "__main__":`' if code == 1 else ""
            raise RuntimeError(f"the process that plans has ended unexpectedly (exit code {code}){hint}")
        self._is_idle = True
        if kind == "error":
            error, where = value
            raise error from RuntimeError(f"in the worker that plans:\n{where}")
        found: tuple[int, Plan] = value
        return found

    def close(self) -> None:
        """End the worker, whatever it is doing; may be called again."""
        self._is_closed = True
        self._close()

    def __enter__(self) -> BackgroundPlanner:
        """Nothing but the planner itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        """Close."""
        self.close()
