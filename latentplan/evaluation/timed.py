"""Episodes in a world that does not wait: time passes in the simulator while the agent thinks.

Time is counted, not slept. One decision of the environment lasts one period of 1000 / `control_hz` milliseconds, and
a thought of d milliseconds takes d of them from the world:

- Decisions begin at the boundaries between periods, with the frame of that moment.
- What was decided acts d milliseconds later, from the simulator's nearest substep on. Until then the last action
  holds, and at an episode's start zeros, clamped into the bounds.
- An agent that still thinks at a boundary misses it: it never sees that frame, the old action holds on, and it
  decides next at the first boundary at which it has finished. Each boundary missed is a deadline miss.
- A plan made beside the decisions is there once it has been asked for and its own duration has passed; it takes
  nothing from the decisions, as on a processor of its own.
- Rendering and simulating cost nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from latentplan.agents.base import Agent
from latentplan.agents.checkpoint import load_agent
from latentplan.agents.modes import MODES
from latentplan.evaluation.clock import VirtualClock, VirtualExecutor
from latentplan.evaluation.episodes import Action, Frame, OnStep, Outcome, play_episode
from latentplan.evaluation.statistics import Episode, EpisodeRecord, latency_percentiles, summarize

WARM_UP_DECISIONS = 2
_ROUNDING = 1e-9  # periods; a thought that ends with a period has not missed its end, whatever its last digit says


class ScheduledEnv(Protocol):
    """An environment whose action can change within a decision; see `SuiteEnv.step_schedule`."""

    substeps_per_decision: int
    action_space: Any

    def reset(self, *, seed: int | None = None) -> tuple[Frame, dict[str, Any]]:
        """The first frame of an episode, and an info."""
        ...

    def step(self, action: Action) -> Outcome:
        """As `step_schedule` with a single action (action,) for the whole decision."""
        ...

    def step_schedule(self, schedule: Sequence[tuple[Action, int]]) -> Outcome:
        """Frame, summed reward, terminated, truncated and info after actions (action,) and their substeps."""
        ...


class Motors:
    """What the body is told while the agent thinks.

    Args:
        rest: Action that holds until the first one acts, (action,).
        substeps: The simulator's substeps in one period.
    """

    def __init__(self, rest: Action, substeps: int) -> None:
        self.substeps = substeps
        self._held = self._coming = rest
        self._wait = 0  # substeps until what comes takes over
        self._thought = 0.0  # periods until it is thought through

    @property
    def is_waiting(self) -> bool:
        """Whether an action is still being thought about."""
        return self._thought > _ROUNDING

    @property
    def latest(self) -> Action:
        """The last action decided, whether or not it acts already, (action,)."""
        return self._coming

    def order(self, action: Action, late_periods: float) -> None:
        """Lets an action (action,) take over, so many periods from now."""
        self._held, self._coming = self._coming, action
        self._wait, self._thought = math.floor(late_periods * self.substeps + 0.5), late_periods

    def next_period(self) -> list[tuple[Action, int]]:
        """The actions of the coming period and their substeps."""
        before = min(self._wait, self.substeps)
        self._wait, self._thought = self._wait - before, self._thought - 1.0
        parts = [(self._held, before), (self._coming, self.substeps - before)]
        return [(action, count) for action, count in parts if count > 0]


def load_timed_agent(path: str | Path, mode: str, clock: VirtualClock, device: str = "cpu", **settings: Any) -> Agent:
    """A trained agent as `load_agent` gives it, except that plans made beside its decisions come by the clock.

    Raises:
        UserError: The checkpoint, the mode or a setting cannot be used.
    """
    if mode in MODES and "make_executor" in MODES[mode].options:
        settings["make_executor"] = partial(VirtualExecutor, clock=clock)
    return load_agent(path, mode, device, **settings)


def iterate_timed_episodes(
    env: ScheduledEnv, agent: Agent, seeds: Sequence[int], clock: VirtualClock, *, on_step: OnStep | None = None
) -> Iterator[Episode]:
    """Plays one episode per seed while the clock runs, each as soon as it has ended.

    Args:
        env: Environment of uint8 frames (height, width, channel); it stays open.
        agent: Reset, and its random stream restarted, before every episode.
        seeds: Seed of each episode's start, see `episode_seed`.
        clock: That charges the agent's thoughts; also the executor of the plans that it makes beside them.
        on_step: Called at every boundary between periods, missed or not, and once more when an episode has ended.
    """
    if seeds and clock.control_hz is not None and not clock.latency.is_replayed:
        _warm_up(env, agent, seeds[0])
    for index, seed in enumerate(seeds):
        yield play_episode(env, agent, index, seed, RunningWorld(env, clock), on_step)


def summarize_timed(episodes: Sequence[Episode], clock: VirtualClock) -> dict[str, Any]:
    """What `summarize` tells, and how the agent kept up with the world, as plain values for JSON.

    Returns:
        Besides: `plan_age_ms` (`p50`, `p95`, `p99`; None without a plan),
        `deadline_misses`, `control_hz` and `latency`. In a world that waits, age, rate and latency are None.
    """
    ages = np.concatenate([episode.plan_age_ms for episode in episodes])
    waits = clock.control_hz is None
    return {
        **summarize(episodes),
        "plan_age_ms": None if waits or not len(ages) else latency_percentiles(ages),
        "deadline_misses": sum(episode.deadline_misses for episode in episodes),
        "control_hz": clock.control_hz,
        "latency": None if waits else clock.latency.name,
    }


class RunningWorld:
    """A world whose time goes on by a virtual clock while the agent decides; see the top of this module.

    Args:
        env: The environment; where the clock stands still only its `step` is used.
        clock: Charges the agent's decisions and plans.
    """

    def __init__(self, env: ScheduledEnv, clock: VirtualClock) -> None:
        self.env, self.clock, self.record = env, clock, EpisodeRecord()
        self._is_running = clock.control_hz is not None
        self._motors = Motors(_rest(env), env.substeps_per_decision if self._is_running else 1)
        self._periods = 0
        self._plan_began_ms = 0.0  # when the frame of the present plan was seen

    def begin(self, seed: int) -> None:
        """Restarts the clock."""
        self.clock.restart(seed)

    def decide(self, agent: Agent, frame: Frame) -> Action:
        """The agent's latest action, (action,): a new one, unless the agent is still busy with an earlier frame."""
        self.clock.advance(self._periods)
        if self._motors.is_waiting:
            self.record.deadline_misses += 1
        else:
            action, decision_ms = self.clock.decide(agent, frame)
            self._motors.order(action, self.clock.periods(decision_ms))
            self.record.add_decision(agent, decision_ms)
            self._record_plan_age(agent, decision_ms)
        return self._motors.latest

    def step(self) -> Outcome:
        """Lets one period pass."""
        self._periods += 1
        if not self._is_running:
            return self.env.step(self._motors.latest)
        return self.env.step_schedule(self._motors.next_period())

    def _record_plan_age(self, agent: Any, decision_ms: float) -> None:
        source = getattr(agent, "last_source", "actor")
        if source == "actor":
            return
        executor = agent.scheduler.executor if hasattr(agent, "scheduler") else None
        if isinstance(executor, VirtualExecutor):
            self._plan_began_ms = executor.asked_ms[agent.scheduler.tick - 1 - agent.plan_age]
        elif source == "plan":
            self._plan_began_ms = self.clock.now_ms
        self.record.plan_age_ms.append(self.clock.now_ms + decision_ms - self._plan_began_ms)


def _rest(env: ScheduledEnv) -> Action:
    """Zeros, clamped into the bounds."""
    space = env.action_space
    rest: Action = np.zeros(space.shape, np.float32).clip(space.low, space.high)
    return rest


def _warm_up(env: ScheduledEnv, agent: Agent, seed: int) -> None:
    """Lets libraries do what they do at a first call, which no robot would leave to its first decision."""
    frame, _ = env.reset(seed=seed)
    agent.reset()
    for _ in range(WARM_UP_DECISIONS):
        agent.act(frame)
