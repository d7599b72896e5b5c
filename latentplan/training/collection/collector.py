"""Collection of experience: agents act in environments, and every frame becomes a row of replay."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch

from latentplan.agents.actor import ActorAgent
from latentplan.agents.base import ModelAgent
from latentplan.agents.modes import make_agent
from latentplan.agents.planning import PlanningAgent
from latentplan.agents.random import RandomAgent
from latentplan.config import Config, EnvironmentFault, derive_seed
from latentplan.config.spaces import Spaces
from latentplan.config.suites import DEFAULT_SUITE
from latentplan.envs import make_vector_env
from latentplan.envs.faults import FrameCheck
from latentplan.envs.registry import USERS_RENDERER, describe_renderer
from latentplan.envs.rendered import time_pictures
from latentplan.envs.rewards import RewardCheck, choose_discount
from latentplan.envs.vector import Restarts, make_guarded_env
from latentplan.evaluation.episodes import OnStep, Step, episode_seed, run_episodes
from latentplan.evaluation.statistics import Episode
from latentplan.models import WorldModel
from latentplan.models.fast import accelerate
from latentplan.models.symmetry import first_turn
from latentplan.replay.buffer import Rows
from latentplan.reporting.film import filming_if_possible
from latentplan.reporting.recorder import EpisodeRecorder, GuardedRecorder
from latentplan.training.collection.episodes import Episodes, Stopped, to_arrays, to_tensors
from latentplan.training.collection.keeping import EpisodeKeeper
from latentplan.training.collection.rounds import RoundLog
from latentplan.training.demonstrations.fitting import read_interface

TRIES = 2  # of the environment before a run starts
FILMED_FRAMES = 250
SHORT_DECISIONS = 50  # of a short episode
CLOSING_SECONDS = 5.0

EnvFactory = Callable[[], gymnasium.Env[Any, Any]]


@dataclass(frozen=True)
class Collected:
    """One round of experience.

    Attributes:
        rows: Rows of each environment in the order of time, one entry per lane of the replay.
        env_frames: Simulator control steps taken in this round.
        decisions: Actions chosen in this round, over all environments.
        episode_returns: Returns of the episodes that ended in this round, without the short ones unless all are short.
            A short episode that ended before its cut is left out too.
        memory: State of the collector after this round, from which `Collector.restore` continues.
        fault: The fault after which no restart was left, and which ended the round early; None in a whole round.
    """

    rows: list[Rows]
    env_frames: int
    decisions: int
    episode_returns: list[float]
    memory: dict[str, Any] | None
    fault: EnvironmentFault | None = None


@dataclass(frozen=True)
class Description:
    """Facts of the environment that the learner needs.

    Attributes:
        action_dim: Size of the action.
        discount: Discount per decision.
        render_ms: Milliseconds per rendered frame.
        renderer: Name and settings of the renderer.
        labels: Quantities that the environment reports with each frame, and the typical size of each.
        spaces: What the networks have to know of actions and observations.
    """

    action_dim: int
    discount: float
    render_ms: float
    renderer: dict[str, str]
    labels: dict[str, float]
    spaces: Spaces


class Collector:
    """Acts in `config.env.num_envs` environments to collect experience, and in one more to evaluate.

    With `collection.enabled` false there is only the environment to evaluate in.

    Args:
        config: Settings of the run.
        make_user_env: Makes the user's own environment; None makes the suite's task.
        device: Device of the acting model.
        number: Number of this collector among those of one run; each number has random streams of its own, and
            evaluations do not depend on it.

    Raises:
        UserError: The environment cannot be made, or a goal in `config.collection.goals` cannot be pursued.
    """

    def __init__(self, config: Config, make_user_env: EnvFactory | None, device: str, number: int = 0) -> None:
        self.config, self._number = config, number
        self._seed = config.run.seed if number == 0 else derive_seed(config.run.seed, "collector", number)
        self._make_user_env = make_user_env
        self.restarts = Restarts(config.collection.max_restarts)
        is_foreign = make_user_env is not None or config.env.suite != DEFAULT_SUITE
        guards: dict[str, Any] = {
            "isolate": config.collection.overlap and is_foreign,
            "step_timeout_s": config.collection.step_timeout_s,
        }
        self._eval_env = make_guarded_env(config.env, self.restarts, make_user_env, **guards)
        try:
            self._episodes = self._make_episodes(guards) if config.collection.enabled else None
            facts = self._eval_env.facts
        except BaseException:
            self._eval_env.close()
            raise
        action_dim = int(np.prod(self._eval_env.action_space.shape or ()))
        self._decisions: int | None = facts["decisions_per_episode"]
        self.discount = discount = config.learning.discount or choose_discount(self._decisions)
        self.labels: dict[str, float] = facts["labels"] or {}
        self.spaces: Spaces = facts["spaces"] or Spaces()
        with torch.random.fork_rng(devices=[]):  # the weights come with each round
            model = WorldModel(config.model, action_dim, self.labels, spaces=self.spaces)
        self.model = accelerate(model.to(device))
        noise, correlation = config.collection.noise_std, config.collection.noise_correlation
        planner, goal_planner = (
            PlanningAgent(self.model, config, discount, noise_std=noise, noise_correlation=correlation)
            for _ in range(2)
        )
        for goal in config.collection.goals:
            goal_planner.set_objective(goal)  # an expression that cannot be pursued is refused before the run starts
        actor = ActorAgent(self.model, config, explore=True, noise_correlation=correlation)
        self._agents: dict[str, ModelAgent] = {"planner": planner, "actor": actor, "goal": goal_planner}
        self._evaluation_agents: dict[str, Any] = {
            mode: make_agent(mode, self.model, config, discount) for mode in ("planner", "actor")
        }
        self._random = RandomAgent(action_dim)
        self._frames: np.ndarray | None = None
        self._labels = np.zeros((config.env.num_envs, len(self.labels) + self.spaces.vector_dim), np.float32)
        self._has_ended = np.ones(config.env.num_envs, dtype=bool)
        self._returns = np.zeros(config.env.num_envs)
        self._check_rewards = RewardCheck(config.env.num_envs, discount)
        self._check_frames = FrameCheck(config.env.num_envs)
        self._has_seen_end = False  # an episode ended in a terminal state
        self._current_agent: ModelAgent | RandomAgent | None = None
        self._recorder: GuardedRecorder | None = None
        self._decision_ms = np.zeros(0)
        self.should_stop: Callable[[], bool] = lambda: False

    def _make_episodes(self, guards: dict[str, Any]) -> Episodes:
        """The environments that collect, and the keeper of their episodes."""
        config = self.config
        num_envs, seed = config.env.num_envs, self._seed
        cut = config.collection.episode_decisions or max(SHORT_DECISIONS, config.learning.sequence_length)
        short = cut, config.collection.short_share
        envs = make_vector_env(config.env, num_envs, seed, self._make_user_env, self.restarts, **guards)
        if config.collection.keep_episodes is None:
            return Episodes(envs, seed, None, *short)
        try:
            facts, folder = self._eval_env.facts, Path(config.collection.keep_episodes)
            if self._number > 0:
                folder /= f"worker-{self._number}"
            keeper = EpisodeKeeper(folder, config.env, read_interface(facts), tuple(facts["labels"] or ()), num_envs)
            return Episodes(envs, seed, keeper, *short)
        except BaseException:
            envs.close(timeout=CLOSING_SECONDS)
            raise

    def describe(self) -> Description:
        """Facts of the environment that the learner needs; renders a few frames to time them."""
        env = self._eval_env
        self._try_environment()
        render_ms = time_pictures(env, self.config.env)
        facts = describe_renderer(self.config.env) if self._make_user_env is None else USERS_RENDERER
        renderer = {name: str(value) for name, value in facts.items()}
        return Description(self.model.action_dim, self.discount, render_ms, renderer, self.labels, self.spaces)

    def _try_environment(self) -> None:
        """Resets and steps once, so that a mistake of the environment ends the run before it starts.

        Raises:
            EnvironmentFault: The environment failed twice; a single failure costs a restart.
        """
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # of the restart
            for seed in range(TRIES):
                try:
                    self._eval_env.reset(seed=seed)
                    self._eval_env.step(np.zeros(self.model.action_dim, np.float32))
                    return
                except EnvironmentFault:
                    if seed == TRIES - 1:
                        raise

    def collect(
        self,
        weights: dict[str, np.ndarray] | None,
        behaviour: str,
        decisions: int,
        counter: int,
        goal: str | None = None,
    ) -> Collected:
        """Collects one round of experience, continuing the episodes of the round before.

        Args:
            weights: State of the world model; None acts at random.
            behaviour: "planner" or "actor".
            decisions: Decisions over all environments, rounded up to a multiple of their number.
            counter: Number of the round, from which its random streams derive.
            goal: Expression that the planner pursues instead of the reward; None pursues the reward.

        Returns:
            The round; where the environments fail too often, its beginning and the fault.

        Raises:
            EnvironmentFault: The environments failed too often before the first decision of the round.
        """
        agent = self._random if weights is None else self._agents[behaviour if goal is None else "goal"]
        if weights is not None:
            self._load_weights(weights)
        if isinstance(agent, PlanningAgent) and goal is not None:
            agent.set_objective(goal)
        if agent is not self._current_agent:
            agent.reset()
            self._current_agent = agent
        agent.seed(derive_seed(self._seed, "collect", counter))
        steps = -(-decisions // len(self._has_ended))
        log = RoundLog(len(self._has_ended), self.model.action_dim, self.config.model.deter_dim)
        taken, fault = 0, None
        try:
            for _ in range(steps):
                if self.should_stop():
                    raise Stopped
                self._restart_ended(agent)
                self._step(agent, log)
                taken += 1
        except EnvironmentFault as error:
            if taken == 0:
                raise
            fault = error
            self._has_ended[:] = True  # the last decision has no result, so no episode can go on
        decisions, memory = taken * len(self._has_ended), self._copy_memory()
        return Collected(log.rows(), log.env_frames, decisions, log.returns, memory, fault)

    def restore(self, memory: dict[str, Any]) -> None:
        """Continues after a round of another collector: plays its running episodes again, action by action.

        Where an environment does not repeat its episode, a new episode begins, and a warning says so.

        Args:
            memory: `Collected.memory` of that round.
        """
        memory = to_tensors(memory)
        self.restarts.count = memory["restarts"]
        if memory["has_seen_end"]:
            self.notice_end()
        assert self._episodes is not None
        frames, labels, is_same = self._episodes.replay(memory["episodes"])
        self._frames, self._returns = frames, memory["returns"].numpy().copy()
        if self._labels.shape[1]:
            self._labels = np.array(labels, np.float32)
        self._has_ended = memory["has_ended"].numpy() | ~is_same
        name = memory["agent"]
        agent = self._random if name == "random" else self._agents[name]
        if isinstance(agent, ModelAgent):
            agent.set_memory(memory["belief"])
        self._current_agent = agent

    def _copy_memory(self) -> dict[str, Any] | None:
        """What `restore` needs, as NumPy arrays and plain values, which pass between processes; None before a start."""
        if self._frames is None:
            return None
        assert self._episodes is not None
        agent = self._current_agent
        names = {id(own): name for name, own in self._agents.items()}
        memory = {
            "agent": names.get(id(agent), "random"),
            "belief": agent.memory() if isinstance(agent, ModelAgent) else None,
            "episodes": self._episodes.memory(self._frames, self._has_ended),
            "returns": self._returns.copy(),
            "has_ended": self._has_ended.copy(),
            "restarts": self.restarts.count,
            "has_seen_end": self._has_seen_end,
        }
        return to_arrays(memory)  # type: ignore[no-any-return]

    def evaluate(
        self,
        episodes: int,
        film: Path | None = None,
        weights: dict[str, np.ndarray] | None = None,
        actor: bool = True,
        record: bool = False,
        first: int = 0,
        every: int = 1,
    ) -> dict[str, list[float]]:
        """Returns of planner and actor, without exploration, in episodes with the same starts.

        Args:
            episodes: Episodes of each agent.
            film: Path of a film of the planner's first episode, or None. A film that cannot be written gives a warning.
            weights: State of the world model; None keeps the weights of the last round.
            actor: Whether the actor is evaluated too.
            record: Whether the planner's first episode is recorded, for `take_recording`.
            first: Number of the first episode that is played here.
            every: Step from one number to the next, where several collectors share the episodes.

        Returns:
            One return per episode that was played, under "planner" and, with `actor`, under "actor".
        """
        if weights is not None:
            self._load_weights(weights)
        stream = derive_seed(self.config.run.seed, "evaluation")
        seeds = [episode_seed(stream, index) for index in range(first, episodes, every)]
        planner = self._evaluation_agents["planner"]
        with contextlib.ExitStack() as stack:
            watchers: list[OnStep] = []
            if film is not None:
                every = -(-(self._decisions or 0) // FILMED_FRAMES) or 1
                watchers.append(stack.enter_context(filming_if_possible(film, self._eval_env, planner, every=every)))
            if record:
                self._recorder = GuardedRecorder(EpisodeRecorder(planner, self._decisions))
                watchers.append(self._recorder)

            def watch(step: Step) -> None:
                for watcher in watchers:
                    watcher(step)

            played = {"planner": self._play(planner, seeds, watch if watchers else None)}
            self._decision_ms = np.concatenate([episode.decision_ms for episode in played["planner"]])
        if actor:
            played["actor"] = self._play(self._evaluation_agents["actor"], seeds)
        return {mode: [episode.total_return for episode in rollouts] for mode, rollouts in played.items()}

    def take_recording(self) -> dict[str, Any]:
        """What a report shows of the latest evaluation that was recorded.

        Returns:
            `recording` (None where nothing was recorded), `decision_ms` (decision,) of the planner, and `period_ms`,
            the time between two decisions in the simulated world (None where it is not known).
        """
        recording = None if self._recorder is None else self._recorder.recording
        rate = self._eval_env.metadata.get("render_fps")
        self._recorder = None
        return {"recording": recording, "decision_ms": self._decision_ms, "period_ms": 1000.0 / rate if rate else None}

    def close(self) -> None:
        """Ends simulators and their processes."""
        if self._episodes is not None:  # without a timeout, close waits forever for a step that failed
            self._episodes.envs.close(timeout=CLOSING_SECONDS)
        self._eval_env.close()

    def _play(self, agent: Any, seeds: Sequence[int], on_step: OnStep | None = None) -> list[Episode]:
        """Whole episodes of an agent; an episode in which the environment failed is played again.

        The second try has the same start. Later ones have starts that derive from it and from the number of the try, as
        an environment may fail from one start alone.

        Raises:
            EnvironmentFault: The environment failed more often than the budget of restarts allows.
        """
        played: list[Episode] = []
        tries = 0
        while len(played) < len(seeds):
            before, seed = self.restarts.count, seeds[len(played)]
            start = seed if tries < 2 else derive_seed(seed, "evaluation try", tries)
            try:
                played += run_episodes(self._eval_env, agent, [start], on_step=None if played else on_step)
                tries = 0
            except EnvironmentFault:
                tries += 1
                if self.restarts.count == before:
                    raise
        return played

    def _load_weights(self, weights: dict[str, np.ndarray]) -> None:
        self.model.load_state_dict({name: torch.tensor(value) for name, value in weights.items()})

    def _restart_ended(self, agent: ModelAgent | RandomAgent) -> None:
        if not self._has_ended.any():
            return
        assert self._episodes is not None
        is_new = self._frames is None
        self._frames, info = self._episodes.restart(self._has_ended)
        if not is_new:
            agent.reset(self._has_ended)
        if self._labels.shape[1]:
            self._labels[self._has_ended] = np.asarray(info["labels"])[self._has_ended]
        self._returns[self._has_ended] = 0.0

    def notice_end(self) -> None:
        """Lets all plans weigh rewards by the probability that the episode goes on, unless the settings decide."""
        if self._has_seen_end or self.config.planner.use_continues is not None:
            return
        self._has_seen_end = True
        for agent in (*self._agents.values(), *self._evaluation_agents.values()):
            if isinstance(agent, PlanningAgent):
                agent.weigh_ends()

    def _step(self, agent: ModelAgent | RandomAgent, log: RoundLog) -> None:
        assert self._frames is not None and self._episodes is not None
        frames, labels, first = self._frames.copy(), self._labels.copy(), self._has_ended.copy()
        vectors = labels[:, len(self.labels) :]
        actions = agent.act((frames, vectors) if self.spaces.vector_dim else frames)
        state = agent.state if isinstance(agent, ModelAgent) else None
        deter = None if state is None else first_turn(state).deter.float().cpu().numpy()
        self._frames, rewards, terminated, truncated, info = self._episodes.step(actions)
        self._check_rewards(rewards, first)
        self._check_frames(frames)
        if terminated.any():
            self.notice_end()
        self._has_ended = terminated | truncated
        self._returns += rewards
        if self._labels.shape[1]:
            self._labels = np.array(info["labels"], np.float32)
        failed = info["failed"]
        log.append(frames, deter, actions, rewards, ~terminated, first, labels, np.asarray(info["env_frames"]), failed)
        for lane in np.flatnonzero(self._has_ended & ~failed):
            last_frame, last_labels = self._frames[lane].copy(), self._labels[lane].copy()  # a restart overwrites both
            log.finish(int(lane), last_frame, last_labels)
            if not self._episodes.is_short[lane] or self.config.collection.short_share == 1.0:
                log.returns.append(float(self._returns[lane]))
