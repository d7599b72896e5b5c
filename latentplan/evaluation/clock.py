"""Milliseconds that are counted, not slept: what thoughts cost in a world that does not wait."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from latentplan.agents.base import Agent
from latentplan.config import derive_seed
from latentplan.evaluation.latency import Charge, Latency
from latentplan.planning.model import State, state_device
from latentplan.planning.objectives import Constraint, Term
from latentplan.planning.plan import Plan

Result = TypeVar("Result")
ROUNDING_MS = 1e-6  # a plan that takes whole periods is there at their end


class VirtualClock:
    """Counts the milliseconds of an episode, and charges thoughts for theirs.

    Args:
        control_hz: Decisions per second of a world that does not wait, above 0; None for a world that waits, where
            the clock stands still and whatever is thought about is there at once.
        latency: What is charged.

    Attributes:
        control_hz: As given.
        latency: As given.
        now_ms: Since the episode began.
        episode: Episodes before this one.
    """

    def __init__(self, control_hz: float | None, latency: Latency) -> None:
        self.control_hz, self.latency = control_hz, latency
        self.episode = -1
        self._decision_began = time.perf_counter()
        self._beside_ms = 0.0  # spent on plans during the decision
        self.restart(0)

    def restart(self, seed: int) -> None:
        """Begins an episode at 0; what is drawn in it depends on the seed alone."""
        self.now_ms, self.episode = 0.0, self.episode + 1
        charges = self.latency.charges(derive_seed(seed, "latency"))
        self._charge_decision: Charge = charges[0]
        self._charge_plan: Charge = charges[1]

    def advance(self, periods: int) -> None:
        """Moves to so many periods of 1000 / `control_hz` milliseconds after the episode's begin."""
        self.now_ms = 0.0 if self.control_hz is None else 1000.0 * periods / self.control_hz

    def periods(self, duration_ms: float) -> float:
        """How much of a period passes in the world while an agent thinks so long."""
        return 0.0 if self.control_hz is None else duration_ms * self.control_hz / 1000.0

    def decide(self, agent: Agent, frame: NDArray[np.uint8]) -> tuple[NDArray[np.float32], float]:
        """The agent's action for a frame seen now, and the milliseconds that the clock charges for it."""
        self._decision_began, self._beside_ms = time.perf_counter(), 0.0
        action = agent.act(frame)
        return action, self._charge_decision(_milliseconds_since(self._decision_began) - self._beside_ms)

    def charge_plan(self, compute: Callable[[], Result]) -> tuple[Result, float]:
        """What is computed beside the decision that goes on, and the time on this clock when it is there."""
        asked_ms = self.now_ms
        if not self.latency.is_replayed:  # after what the decision has done so far
            asked_ms += _milliseconds_since(self._decision_began) - self._beside_ms
        started = time.perf_counter()
        result = compute()
        elapsed_ms = _milliseconds_since(started)
        self._beside_ms += elapsed_ms
        waits = self.control_hz is None
        return result, self.now_ms if waits else asked_ms + self._charge_plan(elapsed_ms)


class VirtualExecutor:
    """Makes plans at once, and hands each over when its duration has passed on the virtual clock.

    Stands in for the worker that plans beside the decisions of a background agent, and takes nothing from them, as on
    a processor of its own. What an episode asked for ends with it.

    Args:
        planner: What searches, such as a `CEMPlanner`.
        model: What it searches in.
        clock: That tells the time, and what plans cost.

    Attributes:
        asked_ms: When the plan for each tick of this episode was asked for, by tick.
    """

    def __init__(self, planner: Any, model: Any, clock: VirtualClock) -> None:
        self.planner, self.model, self.clock = planner, model, clock
        self.asked_ms: dict[int, float] = {}
        self._objective: Term | None = None
        self._constraints: Sequence[Constraint] = ()
        self._episode = clock.episode
        self._pending: tuple[int, Plan, float] | None = None  # tick, plan, when it is there

    @property
    def is_idle(self) -> bool:
        """Whether a request would be taken now."""
        self._follow_episode()
        return self._pending is None

    def set_objective(self, objective: Term | None = None, constraints: Sequence[Constraint] = ()) -> None:
        """Plan for this from the next request on; see `CEMPlanner.plan`."""
        self._objective, self._constraints = objective, constraints

    def request(self, state: State, tick: int, previous: Plan | None = None, seed: int | None = None) -> bool:
        """Makes the plan whose first action is due at `tick`; False (and nothing happens) when one is in work.

        Args:
            state: Where the plan starts, rows (batch,).
            tick: Handed back with the plan.
            previous: Warm start, already shifted.
            seed: Of the search's random stream; None takes torch's default.
        """
        if not self.is_idle:
            return False
        generator = None if seed is None else torch.Generator(state_device(state)).manual_seed(seed)
        goals: dict[str, Any] = {"objective": self._objective, "constraints": self._constraints}
        plan, ready_ms = self.clock.charge_plan(
            lambda: self.planner.plan(self.model, state, previous, generator=generator, **goals)
        )
        self.asked_ms[tick] = self.clock.now_ms
        self._pending = (tick, plan, ready_ms)
        return True

    def poll(self) -> tuple[int, Plan] | None:
        """The finished plan and the tick it was requested for, once; None while there is none."""
        self._follow_episode()
        if self._pending is None or self.clock.now_ms < self._pending[2] - ROUNDING_MS:
            return None
        (tick, plan, _), self._pending = self._pending, None
        return tick, plan

    def _follow_episode(self) -> None:
        if self._episode != self.clock.episode:
            self._episode, self._pending = self.clock.episode, None
            self.asked_ms.clear()


def _milliseconds_since(started: float) -> float:
    return 1000.0 * (time.perf_counter() - started)
