"""Episodes in a world that does not wait while the agent decides.

Time is counted on a virtual clock, without sleeping. One decision of the environment lasts one period of
1000 / `control_hz` milliseconds. A decision that takes d milliseconds has these effects:

- The decision begins at a boundary between two periods, with the frame at this boundary.
- The action takes effect d milliseconds later, from the simulator's nearest substep on. Before that the previous action
  is executed; at the start of an episode the action is zeros, clamped into the bounds.
- At each boundary during the decision the agent misses a deadline: the agent does not get this frame, and the previous
  action goes on. The next decision begins at the first boundary after the end of the present decision.
- A plan computed beside the decisions is ready when its duration has passed since its request. The plan takes no time
  from the decisions, as if plans were computed on another processor.
- Rendering and simulation take no time.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from latentplan.agents.base import Agent, Seen
from latentplan.agents.checkpoint import load_agent
from latentplan.agents.modes import MODES
from latentplan.config import UserError
from latentplan.evaluation.clock import VirtualClock, VirtualExecutor
from latentplan.evaluation.episodes import Action, Frame, OnStep, Outcome, play_episode, see
from latentplan.evaluation.statistics import Episode, EpisodeRecord, latency_percentiles, summarize

WARM_UP_DECISIONS = 2
_ROUNDING = 1e-9  # periods; a decision that ends with a period meets its deadline in spite of rounding


class ScheduledEnv(Protocol):
    """An environment whose action can change within a decision; see `SuiteEnv.step_schedule`.

    Attributes:
        substeps_per_decision: Steps of the simulator in one decision.
        action_space: A Box (action,).
    """

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


class DelayedActions:
    """The actions that are executed in each period, where the action of a decision takes effect with a delay.

    Args:
        rest: Action that is executed until the first decision takes effect, (action,).
        substeps: Substeps of the simulator in one period.
    """

    def __init__(self, rest: Action, substeps: int) -> None:
        self.substeps = substeps
        self._before = self._latest = rest
        self._delay_substeps = 0  # substeps until the latest action takes effect
        self._busy_periods = 0.0  # periods until the decision ends

    @property
    def is_waiting(self) -> bool:
        """Whether the agent is still deciding."""
        return self._busy_periods > _ROUNDING

    @property
    def latest(self) -> Action:
        """The action of the latest decision, (action,), also before it takes effect."""
        return self._latest

    def replace(self, action: Action, delay_periods: float) -> None:
        """Replaces the present action by `action`, (action,), after a delay in periods."""
        self._before, self._latest = self._latest, action
        self._delay_substeps, self._busy_periods = math.floor(delay_periods * self.substeps + 0.5), delay_periods

    def next_period(self) -> list[tuple[Action, int]]:
        """The actions of the coming period, each with its number of substeps, in order."""
        delay = min(self._delay_substeps, self.substeps)
        self._delay_substeps, self._busy_periods = self._delay_substeps - delay, self._busy_periods - 1.0
        parts = [(self._before, delay), (self._latest, self.substeps - delay)]
        return [(action, count) for action, count in parts if count > 0]


def load_timed_agent(path: str | Path, mode: str, clock: VirtualClock, device: str = "cpu", **settings: Any) -> Agent:
    """A trained agent as from `load_agent`, where the clock charges plans that are computed beside the decisions.

    Raises:
        UserError: The checkpoint, the mode or a setting cannot be used.
    """
    if mode in MODES and "make_executor" in MODES[mode].options:
        settings["make_executor"] = partial(VirtualExecutor, clock=clock)
    return load_agent(path, mode, device, **settings)


def iterate_timed_episodes(
    env: ScheduledEnv, agent: Agent, seeds: Sequence[int], clock: VirtualClock, *, on_step: OnStep | None = None
) -> Iterator[Episode]:
    """Plays one episode per seed while the clock runs, and yields each episode as soon as it has ended.

    Args:
        env: Environment of uint8 frames (height, width, channel); it stays open.
        agent: Reset, and its random stream restarted, before every episode.
        seeds: Seed of each episode's start, see `episode_seed`.
        clock: Charges the agent's decisions; the same clock as in `load_timed_agent`.
        on_step: Called at every boundary between periods, missed or not, and once more when an episode has ended.

    Raises:
        UserError: The environment gave a reward that is not finite, or its action cannot change within a decision while
            the clock runs.
    """
    if clock.control_hz is not None and not hasattr(env, "step_schedule"):
        raise UserError("the action of this environment cannot change within a decision: leave out --control-hz")
    if seeds and clock.control_hz is not None and not clock.latency.is_replayed:
        _warm_up(env, agent, seeds[0])
    for index, seed in enumerate(seeds):
        yield play_episode(env, agent, index, seed, RunningWorld(env, clock), on_step)


def summarize_timed(episodes: Sequence[Episode], clock: VirtualClock) -> dict[str, Any]:
    """The result of `summarize`, and figures of real time, as plain values for JSON.

    Returns:
        The keys of `summarize`, and `plan_age_ms` (`p50`, `p95` and `p99`; None without a plan), `deadline_misses`,
        `control_hz` and `latency`. In a world that waits `plan_age_ms`, `control_hz` and `latency` are None.
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
    """A world that goes on while the agent decides, timed by a virtual clock; see the top of this module.

    Args:
        env: The environment; `step_schedule` is called only if the clock runs.
        clock: Charges the agent's decisions and plans.
    """

    def __init__(self, env: ScheduledEnv, clock: VirtualClock) -> None:
        self.env, self.clock, self.record = env, clock, EpisodeRecord()
        self._is_running = clock.control_hz is not None
        self._actions = DelayedActions(_zero_action(env), env.substeps_per_decision if self._is_running else 1)
        self._periods = 0
        self._plan_began_ms = 0.0  # time of the frame that the present plan began with

    def begin(self, seed: int) -> None:
        """Restarts the clock."""
        self.clock.restart(seed)

    def decide(self, agent: Agent, frame: Seen) -> Action:
        """The agent's latest action, (action,): a new action unless the agent is still deciding on an earlier frame."""
        self.clock.advance(self._periods)
        if self._actions.is_waiting:
            self.record.deadline_misses += 1
        else:
            action, decision_ms = self.clock.decide(agent, frame)
            self._actions.replace(action, self.clock.to_periods(decision_ms))
            self.record.add_decision(agent, decision_ms)
            self._record_plan_age(agent, decision_ms)
        return self._actions.latest

    def step(self) -> Outcome:
        """Lets one period pass."""
        self._periods += 1
        if not self._is_running:
            return self.env.step(self._actions.latest)
        return self.env.step_schedule(self._actions.next_period())

    def _record_plan_age(self, agent: Any, decision_ms: float) -> None:
        source = getattr(agent, "last_source", "actor")
        if source == "actor":
            return
        executor = agent.scheduler.executor if hasattr(agent, "scheduler") else None
        if isinstance(executor, VirtualExecutor):
            self._plan_began_ms = executor.requested_ms[agent.scheduler.tick - 1 - agent.plan_age]
        elif source == "plan":
            self._plan_began_ms = self.clock.now_ms
        self.record.plan_age_ms.append(self.clock.now_ms + decision_ms - self._plan_began_ms)


def _zero_action(env: ScheduledEnv) -> Action:
    """An action of zeros, clamped into the bounds."""
    space = env.action_space
    rest: Action = np.zeros(space.shape, np.float32).clip(space.low, space.high)
    return rest


def _warm_up(env: ScheduledEnv, agent: Agent, seed: int) -> None:
    """Makes a few decisions that are not counted, because the first calls of libraries are slow."""
    frame, info = env.reset(seed=seed)
    agent.reset()
    for _ in range(WARM_UP_DECISIONS):
        agent.act(see(frame, info))
