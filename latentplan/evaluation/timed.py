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
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from latentplan.agents.background import BackgroundAgent
from latentplan.agents.checkpoint import Agent as AnyAgent
from latentplan.agents.checkpoint import load_agent
from latentplan.config import derive_seed
from latentplan.evaluation.clock import VirtualClock, VirtualExecutor
from latentplan.evaluation.episodes import Agent, OnStep, Step, finite
from latentplan.evaluation.statistics import SOURCES, Episode, Floats, latency_percentiles, summarize

Action = NDArray[np.float32]

WARM_UP_DECISIONS = 2
_ROUNDING = 1e-9  # periods; a thought that ends with a period has not missed its end, whatever its last digit says


class ScheduledEnv(Protocol):
    """An environment whose action can change within a decision; see `SuiteEnv.step_schedule`."""

    substeps_per_decision: int
    action_space: Any

    def reset(self, *, seed: int | None = None) -> tuple[NDArray[np.uint8], dict[str, Any]]:
        """The first frame of an episode, and an info."""
        ...

    def step_schedule(
        self, schedule: Sequence[tuple[Action, int]]
    ) -> tuple[NDArray[np.uint8], float, bool, bool, dict[str, Any]]:
        """Frame, summed reward, terminated, truncated and info after actions (action,) and their substeps."""
        ...


@dataclass(frozen=True)
class TimedEpisode(Episode):
    """What an episode on the virtual clock came to; `decision_ms` is what the clock charged.

    Attributes:
        deadline_misses: Boundaries at which the agent was still thinking.
        plan_age_ms: For each action from a plan: from the frame that the plan began with until the action acts.
    """

    deadline_misses: int = 0
    plan_age_ms: Floats = field(default_factory=lambda: np.zeros(0))


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


def load_timed_agent(
    path: str | Path, mode: str, clock: VirtualClock, device: str = "cpu", **settings: Any
) -> AnyAgent | BackgroundAgent:
    """A trained agent as `load_agent` gives it, except that plans made beside its decisions come by the clock.

    Raises:
        UserError: The checkpoint, the mode or a setting cannot be used.
    """
    if mode == "background":
        settings["make_executor"] = partial(VirtualExecutor, clock=clock)
    return load_agent(path, mode, device, **settings)


def iterate_timed_episodes(
    env: ScheduledEnv, agent: Agent, seeds: Sequence[int], clock: VirtualClock, *, on_step: OnStep | None = None
) -> Iterator[TimedEpisode]:
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
        yield _run_episode(env, agent, index, seed, clock, on_step)


def summarize_timed(episodes: Sequence[TimedEpisode], clock: VirtualClock) -> dict[str, Any]:
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


def _run_episode(
    env: ScheduledEnv, agent: Agent, index: int, seed: int, clock: VirtualClock, on_step: OnStep | None
) -> TimedEpisode:
    frame, _ = env.reset(seed=seed)
    agent.reset()
    agent.seed(derive_seed(seed, "agent"))
    clock.restart(seed)
    motors = Motors(_rest(env), env.substeps_per_decision)
    record = _Record()
    total_return, env_frames, periods, over = 0.0, 0, 0, False
    while not over:
        clock.advance(periods)
        if motors.is_waiting:
            record.deadline_misses += 1
        else:
            action, decision_ms = clock.decide(agent, frame)
            motors.order(action, clock.periods(decision_ms))
            record.add(agent, clock.now_ms, decision_ms)
        if on_step is not None:
            on_step(Step(index, periods, total_return, frame, motors.latest))
        frame, reward, terminated, truncated, info = env.step_schedule(motors.next_period())
        total_return += finite(reward)
        env_frames += int(info.get("env_frames", 1))
        periods += 1
        over = terminated or truncated
    if on_step is not None:
        on_step(Step(index, periods, total_return, frame, None))
    return record.episode(total_return, env_frames)


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


class _Record:
    """What is counted in an episode."""

    def __init__(self) -> None:
        self.deadline_misses = 0
        self._decision_ms: list[float] = []
        self._sources = dict.fromkeys(SOURCES, 0)
        self._surprised = 0
        self._plan_age_ms: list[float] = []
        self._planned_ms = 0.0  # when the present plan's frame was seen

    def add(self, agent: Agent, now_ms: float, decision_ms: float) -> None:
        """Counts a decision that began now."""
        self._decision_ms.append(decision_ms)
        source = getattr(agent, "last_source", "actor")
        self._sources[source] += 1
        self._surprised += getattr(agent, "was_surprised", False)
        if source == "actor":
            return
        if isinstance(agent, BackgroundAgent) and isinstance(agent.scheduler.executor, VirtualExecutor):
            assert agent.plan_age is not None
            self._planned_ms = agent.scheduler.executor.asked_ms[agent.scheduler.tick - 1 - agent.plan_age]
        elif source == "plan":
            self._planned_ms = now_ms
        self._plan_age_ms.append(now_ms + decision_ms - self._planned_ms)

    def episode(self, total_return: float, env_frames: int) -> TimedEpisode:
        """The episode that was counted."""
        return TimedEpisode(
            total_return,
            len(self._decision_ms),
            env_frames,
            np.asarray(self._decision_ms),
            self._sources,
            self._surprised,
            self.deadline_misses,
            np.asarray(self._plan_age_ms),
        )
