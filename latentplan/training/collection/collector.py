"""Gathering experience: agents act in environments and hand over the rows for replay."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch

from latentplan.agents.actor import ActorAgent
from latentplan.agents.base import ModelAgent
from latentplan.agents.planning import PlanningAgent
from latentplan.agents.random import RandomAgent
from latentplan.config import Config, derive_seed
from latentplan.envs import make_env, make_from, make_vector_env, render_info
from latentplan.evaluation.episodes import episode_seed, run_episodes
from latentplan.models import WorldModel
from latentplan.models.fast import accelerate
from latentplan.models.symmetry import first_turn
from latentplan.replay.buffer import Rows
from latentplan.reporting.film import filming_if_possible
from latentplan.training.collection.rewards import RewardCheck

TIMED_FRAMES = 5
FILMED_FRAMES = 250
CLOSING_SECONDS = 5.0

EnvFactory = Callable[[], gymnasium.Env[Any, Any]]


@dataclass(frozen=True)
class Collected:
    """One round of experience.

    Attributes:
        rows: What each environment saw, in order, one entry per lane.
        env_frames: Simulator control steps taken.
        decisions: Actions chosen.
        episode_returns: Of the episodes that ended in this round.
    """

    rows: list[Rows]
    env_frames: int
    decisions: int
    episode_returns: list[float]


@dataclass(frozen=True)
class Description:
    """What the learner has to know of the environment.

    Attributes:
        action_dim: Size of the action.
        discount: Per decision.
        render_ms: Milliseconds per rendered frame.
        renderer: What draws it.
        labels: Quantities that it tells with each frame, and the typical size of each.
    """

    action_dim: int
    discount: float
    render_ms: float
    renderer: dict[str, str]
    labels: dict[str, float]


class Collector:
    """Acts in `config.env.num_envs` environments, and evaluates in one of its own.

    Args:
        config: Settings of the run.
        make_user_env: The user's factory, or None for the suite.
        device: Where the acting model lives.
    """

    def __init__(self, config: Config, make_user_env: EnvFactory | None, device: str) -> None:
        self.config = config
        self._make_user_env = make_user_env
        self.envs = make_vector_env(
            config.env, config.env.num_envs, config.run.seed, make_user_env, config.collection.episode_decisions
        )
        build = make_env if make_user_env is None else make_from(make_user_env)
        self._eval_env = build(config.env, 0)
        action_dim = int(np.prod(self.envs.single_action_space.shape or ()))
        self._decisions: int | None = getattr(self._eval_env.unwrapped, "decisions_per_episode", None)
        self.discount = discount = config.learning.discount or _discount_for(self._decisions)
        self.labels: dict[str, float] = getattr(self._eval_env.unwrapped, "labels", {})
        self.model = accelerate(WorldModel(config.model, action_dim, self.labels).to(device))
        noise, correlation = config.collection.noise_std, config.collection.noise_correlation
        planners = {
            (who, noisy): PlanningAgent(
                self.model, config, discount, noise_std=noise if noisy else 0.0, noise_correlation=correlation
            )
            for who in ("planner", "goal")
            for noisy in (True, False)
        }
        for goal in config.collection.goals:
            planners["goal", True].set_objective(goal)  # to be refused now, if at all
        self._agents: dict[tuple[str, bool], ModelAgent] = {
            **planners,
            ("actor", True): ActorAgent(self.model, config, explore=True, noise_correlation=correlation),
            ("actor", False): ActorAgent(self.model, config),
        }
        self._judged: dict[str, ModelAgent] = {
            "planner": PlanningAgent(self.model, config, discount),
            "actor": ActorAgent(self.model, config),
        }
        self._random = RandomAgent(action_dim)
        self._frames: np.ndarray | None = None
        self._labels = np.zeros((config.env.num_envs, len(self.labels)), np.float32)
        self._ended = np.ones(config.env.num_envs, dtype=bool)
        self._returns = np.zeros(config.env.num_envs)
        self._check = RewardCheck(config.env.num_envs, discount)
        self._acting: object = None

    def describe(self) -> Description:
        """What the learner has to know of the environment."""
        self._eval_env.reset(seed=0)
        started = time.perf_counter()
        for _ in range(TIMED_FRAMES):
            self._eval_env.render()
        render_ms = 1000.0 * (time.perf_counter() - started) / TIMED_FRAMES
        facts = render_info() if self._make_user_env is None else {"renderer": "the user's environment"}
        renderer = {name: str(value) for name, value in facts.items()}
        return Description(self.model.action_dim, self.discount, render_ms, renderer, self.labels)

    def collect(
        self,
        weights: dict[str, np.ndarray] | None,
        behaviour: str,
        decisions: int,
        counter: int,
        noisy: bool = True,
        goal: str | None = None,
    ) -> Collected:
        """Take `decisions` decisions in all, with new weights; continues the episodes of the last round.

        Args:
            weights: State of the world model; None acts at random.
            behaviour: `planner` or `actor`.
            decisions: Rounded up to a multiple of the number of environments.
            counter: Number of the round, from which its random stream derives.
            noisy: Whether it explores, or acts as it is evaluated.
            goal: What the planner pursues in place of the reward; its plans are not kept for the actor to imitate.
        """
        agent = self._random if weights is None else self._agents[behaviour if goal is None else "goal", noisy]
        if weights is not None:
            self._load(weights)
        if isinstance(agent, PlanningAgent) and goal is not None:
            agent.set_objective(goal)
        if agent is not self._acting:
            agent.reset()
            self._acting = agent
        agent.seed(derive_seed(self.config.run.seed, "collect", counter))
        steps = -(-decisions // len(self._ended))
        log = _Log(len(self._ended), self.model.action_dim, self.config.model.deter_dim)
        for _ in range(steps):
            self._restart_ended(agent, counter)
            self._step(agent, log)
        return Collected(log.rows(), log.env_frames, steps * len(self._ended), log.returns)

    def evaluate(
        self,
        episodes: int,
        film: Path | None = None,
        weights: dict[str, np.ndarray] | None = None,
        actor: bool = True,
    ) -> dict[str, list[float]]:
        """Returns of planner and actor on the same starts, without exploration.

        Args:
            episodes: Episodes of each.
            film: Where the planner's first episode is filmed, if anywhere; where that fails there is a warning.
            weights: State of the world model; None keeps that of the last round.
            actor: Whether the actor plays too; without, only the planner's returns are given.
        """
        if weights is not None:
            self._load(weights)
        stream = derive_seed(self.config.run.seed, "evaluation")
        seeds = [episode_seed(stream, index) for index in range(episodes)]
        planner = self._judged["planner"]
        with contextlib.ExitStack() as stack:
            on_step = None
            if film is not None:
                every = -(-(self._decisions or 0) // FILMED_FRAMES) or 1
                on_step = stack.enter_context(filming_if_possible(film, self._eval_env, planner, every=every))
            played = {"planner": run_episodes(self._eval_env, planner, seeds, on_step=on_step)}
        if actor:
            played["actor"] = run_episodes(self._eval_env, self._judged["actor"], seeds)
        return {mode: [episode.total_return for episode in rollouts] for mode, rollouts in played.items()}

    def close(self) -> None:
        """Free simulators and processes."""
        self.envs.close(timeout=CLOSING_SECONDS)  # without, a step that failed is waited for again, for ever
        self._eval_env.close()

    def _load(self, weights: dict[str, np.ndarray]) -> None:
        self.model.load_state_dict({name: torch.from_numpy(value) for name, value in weights.items()})

    def _restart_ended(self, agent: ModelAgent | RandomAgent, counter: int) -> None:
        if not self._ended.any():
            return
        if self._frames is None:
            self._frames, info = self.envs.reset(seed=derive_seed(self.config.run.seed, "episodes", counter))
        else:
            self._frames, info = self.envs.reset(options={"reset_mask": self._ended})
            agent.reset(self._ended)
        if self.labels:
            self._labels[self._ended] = np.asarray(info["labels"])[self._ended]
        self._returns[self._ended] = 0.0

    def _step(self, agent: ModelAgent | RandomAgent, log: _Log) -> None:
        assert self._frames is not None
        frames, labels, first = self._frames.copy(), self._labels.copy(), self._ended.copy()
        actions = agent.act(frames)
        state = agent.state if isinstance(agent, ModelAgent) else None
        deter = None if state is None else first_turn(state).deter.float().cpu().numpy()
        plan = None
        if isinstance(agent, PlanningAgent) and agent.controller.objective is None:
            plan = agent.planned_action()
        self._frames, rewards, terminated, truncated, info = self.envs.step(actions)
        self._check(rewards, first)
        self._ended = terminated | truncated
        self._returns += rewards
        if self.labels:
            self._labels = np.array(info["labels"], np.float32)
        log.append(frames, deter, actions, rewards, ~terminated, first, labels, np.asarray(info["env_frames"]), plan)
        for lane in np.flatnonzero(self._ended):
            frame, row = self._frames[lane].copy(), self._labels[lane].copy()  # both are written over by a restart
            log.finish(int(lane), frame, row, float(self._returns[lane]))


def _discount_for(decisions: int | None) -> float:
    """A horizon of a fifth of an episode: 0.96 at 125 decisions, 0.99 at 500."""
    return 1.0 - 5.0 / min(max(decisions or 500, 50), 1000)


class _Log:
    """Rows of every lane while a round lasts."""

    def __init__(self, lanes: int, action_dim: int, deter_dim: int) -> None:
        self._lanes: list[list[tuple[Any, ...]]] = [[] for _ in range(lanes)]
        self._no_deter = np.zeros((lanes, deter_dim), np.float32)
        self._no_action = np.zeros(action_dim, np.float32)
        self._no_plan = np.zeros((lanes, 2 * action_dim), np.float32)
        self.returns: list[float] = []
        self.env_frames = 0

    def append(
        self,
        frames: np.ndarray,
        deter: np.ndarray | None,
        actions: np.ndarray,
        rewards: np.ndarray,
        continues: np.ndarray,
        first: np.ndarray,
        labels: np.ndarray,
        env_frames: np.ndarray,
        plan: np.ndarray | None,
    ) -> None:
        beliefs = self._no_deter if deter is None else deter
        plans = self._no_plan if plan is None else plan
        for lane, entries in enumerate(self._lanes):
            row = (frames, beliefs, actions, rewards, continues.astype(np.float32), first, labels, plans)
            entries.append(tuple(part[lane] for part in row))
        self.env_frames += int(env_frames.sum())

    def finish(self, lane: int, frame: np.ndarray, labels: np.ndarray, total_return: float) -> None:
        self._lanes[lane].append(
            (frame, self._no_deter[lane], self._no_action, 0.0, 1.0, False, labels, self._no_plan[lane])
        )
        self.returns.append(total_return)

    def rows(self) -> list[Rows]:
        return [_stack(entries) for entries in self._lanes]


def _stack(entries: list[tuple[Any, ...]]) -> Rows:
    frames, deter, actions, rewards, continues, is_first, labels, plan = zip(*entries, strict=True)
    return Rows(
        frames=np.stack(frames),
        deter=np.stack(deter),
        actions=np.stack(actions),
        rewards=np.asarray(rewards, np.float32),
        continues=np.asarray(continues, np.float32),
        is_first=np.asarray(is_first, bool),
        labels=np.stack(labels),
        plan=np.stack(plan),
    )
