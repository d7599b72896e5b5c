"""A virtual clock, which counts the milliseconds of decisions and plans without sleeping, and their latencies."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from latentplan.agents.base import Agent, Seen
from latentplan.config import derive_seed
from latentplan.config.latency import MEASURED, read_durations
from latentplan.planning.model import State, state_device
from latentplan.planning.objectives import Constraint, Term
from latentplan.planning.plan import Plan

Result = TypeVar("Result")
ROUNDING_MS = 1e-6  # tolerance, so that a plan that takes whole periods is ready at the end of a period


class VirtualClock:
    """Counts the milliseconds of an episode, and charges decisions and plans for their durations.

    Args:
        control_hz: Decisions per second, above 0, of a world that goes on while the agent decides; None for a world
            that waits, in which the clock stands still and every plan is ready at once.
        latency: The durations that are charged.

    Attributes:
        control_hz: As given.
        latency: As given.
        now_ms: Milliseconds since the episode began.
        episode: Number of episodes before this one.
    """

    def __init__(self, control_hz: float | None, latency: Latency) -> None:
        self.control_hz, self.latency = control_hz, latency
        self.episode = -1
        self._decision_began = time.perf_counter()
        self._plan_ms = 0.0  # time spent on plans during the present decision
        self.restart(0)

    def restart(self, seed: int) -> None:
        """Begins an episode at 0 ms; the durations of the episode depend on the seed alone."""
        self.now_ms, self.episode = 0.0, self.episode + 1
        charges = self.latency.charges(derive_seed(seed, "latency"))
        self._charge_decision: Charge = charges[0]
        self._charge_plan: Charge = charges[1]

    def advance(self, periods: int) -> None:
        """Sets the clock to a number of periods of 1000 / `control_hz` milliseconds after the start of the episode."""
        self.now_ms = 0.0 if self.control_hz is None else 1000.0 * periods / self.control_hz

    def to_periods(self, duration_ms: float) -> float:
        """A duration as a number of periods of the world; 0 in a world that waits."""
        return 0.0 if self.control_hz is None else duration_ms * self.control_hz / 1000.0

    def decide(self, agent: Agent, frame: Seen) -> tuple[NDArray[np.float32], float]:
        """The agent's action, (action,), for the present frame, and the milliseconds charged for the decision."""
        self._decision_began, self._plan_ms = time.perf_counter(), 0.0
        action = agent.act(frame)
        return action, self._charge_decision(_elapsed_ms(self._decision_began) - self._plan_ms)

    def charge_plan(self, compute: Callable[[], Result]) -> tuple[Result, float]:
        """The result of a computation beside the present decision, and the time in ms at which the result is ready."""
        requested_ms = self.now_ms
        if not self.latency.is_replayed:  # the decision took time before its request for the plan
            requested_ms += _elapsed_ms(self._decision_began) - self._plan_ms
        started = time.perf_counter()
        result = compute()
        elapsed_ms = _elapsed_ms(started)
        self._plan_ms += elapsed_ms
        waits = self.control_hz is None
        return result, self.now_ms if waits else requested_ms + self._charge_plan(elapsed_ms)


class VirtualExecutor:
    """Computes each plan at once, and returns it when its duration has passed on the virtual clock.

    The executor replaces the worker of a background agent. Plans take no time from the decisions, as if plans were
    computed on another processor. A pending plan is dropped when the next episode begins.

    Args:
        planner: The planner, such as a `CEMPlanner`.
        model: The model that the planner searches in.
        clock: The clock that charges the plans.

    Attributes:
        requested_ms: Time in ms at which each plan of this episode was requested, by the tick of its first action.
    """

    def __init__(self, planner: Any, model: Any, clock: VirtualClock) -> None:
        self.planner, self.model, self.clock = planner, model, clock
        self.requested_ms: dict[int, float] = {}
        self._objective: Term | None = None
        self._constraints: Sequence[Constraint] = ()
        self._episode = clock.episode
        self._pending: tuple[int, Plan, float] | None = None  # tick, plan, time in ms at which it is ready

    @property
    def is_idle(self) -> bool:
        """Whether a request would be accepted now."""
        self._drop_earlier_episode()
        return self._pending is None

    def set_objective(self, objective: Term | None = None, constraints: Sequence[Constraint] = ()) -> None:
        """Sets the objective and the constraints of all later requests; see `CEMPlanner.plan`."""
        self._objective, self._constraints = objective, constraints

    def request(self, state: State, tick: int, previous: Plan | None = None, seed: int | None = None) -> bool:
        """Computes a plan, unless another plan is pending; returns whether the request was accepted.

        Args:
            state: State that the plan starts from, with rows (batch,).
            tick: Decision of the plan's first action; `poll` returns it with the plan.
            previous: Plan for a warm start, already shifted.
            seed: Seed of the search's random stream; None takes torch's default stream.
        """
        if not self.is_idle:
            return False
        generator = None if seed is None else torch.Generator(state_device(state)).manual_seed(seed)
        goals: dict[str, Any] = {"objective": self._objective, "constraints": self._constraints}
        plan, ready_ms = self.clock.charge_plan(
            lambda: self.planner.plan(self.model, state, previous, generator=generator, **goals)
        )
        self.requested_ms[tick] = self.clock.now_ms
        self._pending = (tick, plan, ready_ms)
        return True

    def poll(self) -> tuple[int, Plan] | None:
        """The tick and the plan of the pending request, once, as soon as the plan is ready; else None."""
        self._drop_earlier_episode()
        if self._pending is None or self.clock.now_ms < self._pending[2] - ROUNDING_MS:
            return None
        (tick, plan, _), self._pending = self._pending, None
        return tick, plan

    def _drop_earlier_episode(self) -> None:
        if self._episode != self.clock.episode:
            self._episode, self._pending = self.clock.episode, None
            self.requested_ms.clear()


def _elapsed_ms(started: float) -> float:
    return 1000.0 * (time.perf_counter() - started)


Milliseconds = NDArray[np.float64]
Charge = Callable[[float], float]  # from measured milliseconds to charged milliseconds


@dataclass(frozen=True)
class Latency:
    """The durations that the virtual clock charges.

    Attributes:
        name: `measured`, or the file that the durations came from.
        decision_ms: Durations of decisions, (duration,); None charges the measured durations.
        plan_ms: Durations of plans that are computed beside the decisions, (duration,). Given durations count from the
            frame that the plan begins with, measured durations from the request of the plan. None charges the measured
            durations.
    """

    name: str = MEASURED
    decision_ms: Milliseconds | None = None
    plan_ms: Milliseconds | None = None

    @property
    def is_replayed(self) -> bool:
        """Whether durations are drawn from a distribution, so that results repeat exactly."""
        return self.decision_ms is not None

    def charges(self, seed: int) -> tuple[Charge, Charge]:
        """The charges of decisions and of plans in an episode: two random streams that depend on the seed alone."""
        decision = _make_charge(self.decision_ms, derive_seed(seed, "decision_ms"))
        return decision, _make_charge(self.plan_ms, derive_seed(seed, "plan_ms"))


def read_latency(text: str) -> Latency:
    """The latency that `--latency` names: `measured`, or a file of milliseconds; see `read_durations`.

    Raises:
        UserError: The file cannot be read, or does not hold durations.
    """
    durations = read_durations(text)
    return Latency() if durations is None else Latency(text, *(np.asarray(values) for values in durations))


def _make_charge(durations: Milliseconds | None, seed: int) -> Charge:
    if durations is None:
        return lambda measured_ms: measured_ms
    rng, known = np.random.default_rng(seed), durations
    return lambda measured_ms: float(rng.choice(known))
