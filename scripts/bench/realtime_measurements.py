"""Measurements of `benchmark.py realtime`: returns and decision times of a trained agent, and prediction errors."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from latentplan.envs.suite import SuiteEnv
    from latentplan.evaluation.statistics import Episode

ITERATIONS = {  # the first search of a warm planner is cold, with 5 iterations as in the cold planner
    "5 cold": {"num_iterations": 5, "warm_start": False},
    **{f"{count} warm": {"num_iterations": 5, "warm_start_iterations": count} for count in (5, 3, 2, 1)},
}
AGENTS = ("planner", "deadline", "background", "gated", "actor")
REPLAN_EVERY = (1, 2, 5, 10, 20)
IMAGINED_STEPS = 20
START_EVERY = 5  # decisions between the starts of imagined rollouts
Row = dict[str, Any]


@dataclass(frozen=True)
class Trial:
    """A trained agent, its environment, and the starts of its episodes.

    Attributes:
        checkpoint: Folder of a checkpoint or of a run.
        device: `cpu` or `cuda`.
        env: Environment of the checkpoint.
        seeds: Seeds of the starts of the episodes.
        horizon: Horizon of the search in the checkpoint, in model steps.
    """

    checkpoint: str
    device: str
    env: SuiteEnv
    seeds: Sequence[int]
    horizon: int

    def play(
        self,
        mode: str,
        settings: Mapping[str, Any],
        control_hz: float | None = None,
        prepare: Callable[[Any], None] | None = None,
    ) -> Row:
        """Plays one episode per seed; returns the result of `summarize_timed` and `mean_decision_ms`.

        Args:
            mode: Mode of the agent.
            settings: Settings of the search that replace the settings of the checkpoint.
            control_hz: Decisions per second of an environment that does not wait; None for one that waits.
            prepare: Changes the agent before it plays.
        """
        from latentplan.evaluation.clock import Latency, VirtualClock
        from latentplan.evaluation.timed import iterate_timed_episodes, load_timed_agent, summarize_timed

        clock = VirtualClock(control_hz, Latency())
        agent = load_timed_agent(self.checkpoint, mode, clock, self.device, **settings)
        if prepare is not None:
            prepare(agent)
        episodes: list[Episode] = list(iterate_timed_episodes(self.env, agent, self.seeds, clock))
        return {**summarize_timed(episodes, clock), "mean_decision_ms": _mean_decision_ms(episodes)}


def measure_iterations(trial: Trial) -> Iterator[Row]:
    """Yields decision time and return by the iterations of a search, in an environment that waits."""
    for name, settings in ITERATIONS.items():
        yield {"iterations": name, **trial.play("planner", settings)}


def measure_rates(trial: Trial, rates: Sequence[float]) -> Iterator[Row]:
    """Yields the return by the control rate of an environment that does not wait, for every agent."""
    for control_hz in rates:
        for name in AGENTS:
            mode = "planner" if name == "deadline" else name
            settings = {"deadline_ms": 1000.0 / control_hz} if name == "deadline" else {}
            yield {"agent": name, **trial.play(mode, settings, control_hz)}


def measure_replanning(trial: Trial) -> Iterator[Row]:
    """Yields the return by the number of actions executed from each plan, in an environment that waits."""
    for every in REPLAN_EVERY:
        horizon = max(trial.horizon, every)  # a plan must hold all actions that are executed

        def replan(agent: Any, every: int = every) -> None:
            agent.controller.replan_every = every

        yield {"replan_every": every, "horizon": horizon, **trial.play("planner", {"horizon": horizon}, prepare=replan)}


def measure_error(trial: Trial) -> Iterator[Row]:
    """Yields the distance between imagined and observed latents and rewards by model steps, in episodes of the actor.

    Each row also holds the errors of predicting no change, with latent and reward as at the start.
    """
    from latentplan.agents.checkpoint import load_agent

    agent: Any = load_agent(trial.checkpoint, mode="actor", device=trial.device)
    parts = [_prediction_errors(agent.model, *_record_episode(agent, trial.env, seed)) for seed in trial.seeds]
    names = ("latent_distance", "reward_error", "latent_change", "reward_change")
    for step, values in enumerate(mean_errors(parts), start=1):
        yield {"step": step, **dict(zip(names, values, strict=True))}


def mean_errors(parts: Sequence[np.ndarray]) -> list[list[float]]:
    """Means over the starts of all episodes, by step; a step is that of the episodes that are long enough for it.

    Args:
        parts: Errors (step, start, 4) of each episode.
    """
    steps = max(map(len, parts))
    return [
        np.concatenate([part[step] for part in parts if step < len(part)]).mean(axis=0).tolist()
        for step in range(steps)
    ]


def _record_episode(agent: Any, env: SuiteEnv, seed: int) -> tuple[list[Any], list[np.ndarray], list[float]]:
    """Beliefs of an episode, the action at each belief, and the reward that followed the action."""
    from latentplan.evaluation.episodes import see
    from latentplan.models.symmetry import first_turn

    beliefs, actions, rewards = [], [], []
    agent.reset()
    seen, is_over = see(*env.reset(seed=seed)), False
    while not is_over:
        action = agent.act(seen)
        beliefs.append(first_turn(agent.state))
        actions.append(action)
        frame, reward, terminated, truncated, info = env.step(action)
        seen = see(frame, info)
        rewards.append(reward)
        is_over = terminated or truncated
    return beliefs, actions, rewards


def _prediction_errors(model: Any, beliefs: list[Any], actions: list[np.ndarray], rewards: list[float]) -> np.ndarray:
    """Errors (step, start, 4): latent distance and reward error of the model, and of predicting no change."""
    import torch

    steps = max(0, min(IMAGINED_STEPS, len(beliefs) - 2))
    starts = torch.arange(1, len(beliefs) - steps, START_EVERY)
    taken = torch.as_tensor(np.stack(actions), device=model.device)
    all_rewards = torch.tensor(rewards, device=model.device)
    latents = torch.cat([belief.stoch for belief in beliefs])
    state = type(beliefs[0])(*(torch.cat(parts)[starts] for parts in zip(*beliefs, strict=True)))
    rows = []
    with torch.no_grad():
        for step in range(steps):
            state, reward = model.step(state, taken[starts + step])
            latent, observed_reward = latents[starts + step + 1], all_rewards[starts + step]
            columns = (
                (state.stoch - latent).norm(dim=-1),
                (reward - observed_reward).abs(),
                (latents[starts] - latent).norm(dim=-1),
                (all_rewards[starts - 1] - observed_reward).abs(),
            )
            rows.append(torch.stack([column.float().cpu() for column in columns], dim=-1))
    return torch.stack(rows).numpy() if rows else np.zeros((0, 0, 4))


def _mean_decision_ms(episodes: Sequence[Episode]) -> float:
    return float(np.mean(np.concatenate([episode.decision_ms for episode in episodes])))
