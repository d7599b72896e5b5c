"""What thinking earns and costs a trained agent, part by part."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from latentplan.envs.suite import SuiteEnv
    from latentplan.evaluation.timed import TimedEpisode

ITERATIONS = {  # warm searches have their cold first one do as much as the cold ones do
    "5 cold": {"num_iterations": 5, "warm_start": False},
    **{f"{count} warm": {"num_iterations": 5, "warm_start_iterations": count} for count in (5, 3, 2, 1)},
}
AGENTS = ("planner", "deadline", "background", "gated", "actor")
REPLAN_EVERY = (1, 2, 5, 10, 20)
IMAGINED_STEPS = 20
START_EVERY = 5  # decisions between the starts of imagination
Row = dict[str, Any]


@dataclass(frozen=True)
class Trial:
    """Who is measured, and where.

    Attributes:
        checkpoint: A checkpoint, or a run folder.
        device: `cpu` or `cuda`.
        env: The checkpoint's environment.
        seeds: Of the episodes' starts.
        horizon: Of the checkpoint's own search.
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
        """One episode per seed: return with interval, latency, and what `summarize_timed` tells besides.

        Args:
            mode: Of the agent.
            settings: Of the search, in place of the checkpoint's.
            control_hz: Of a world that does not wait for what thinking takes here; None for one that waits.
            prepare: Changes the agent before it plays.
        """
        from latentplan.evaluation.clock import VirtualClock
        from latentplan.evaluation.latency import Latency
        from latentplan.evaluation.timed import iterate_timed_episodes, load_timed_agent, summarize_timed

        clock = VirtualClock(control_hz, Latency())
        agent = load_timed_agent(self.checkpoint, mode, clock, self.device, **settings)
        if prepare is not None:
            prepare(agent)
        episodes: list[TimedEpisode] = list(iterate_timed_episodes(self.env, agent, self.seeds, clock))
        return {**summarize_timed(episodes, clock), "mean_decision_ms": _mean_decision_ms(episodes)}


def measure_iterations(trial: Trial) -> Iterator[Row]:
    """Latency and return by the refits of a search, in a world that waits."""
    for name, settings in ITERATIONS.items():
        yield {"iterations": name, **trial.play("planner", settings)}


def measure_rates(trial: Trial, rates: Sequence[float]) -> Iterator[Row]:
    """Return by the rate of a world that does not wait, for every way to decide."""
    for control_hz in rates:
        for name in AGENTS:
            mode = "planner" if name == "deadline" else name
            settings = {"deadline_ms": 1000.0 / control_hz} if name == "deadline" else {}
            yield {"agent": name, **trial.play(mode, settings, control_hz)}


def measure_replanning(trial: Trial) -> Iterator[Row]:
    """Return by the actions that are executed from each plan, in a world that waits."""
    for every in REPLAN_EVERY:
        horizon = max(trial.horizon, every)  # a plan must be as long as it is executed

        def replan(agent: Any, every: int = every) -> None:
            agent.controller.replan_every = every

        yield {"replan_every": every, "horizon": horizon, **trial.play("planner", {"horizon": horizon}, prepare=replan)}


def measure_error(trial: Trial) -> Iterator[Row]:
    """How far imagination leaves what is then seen, by the steps imagined, along episodes of the actor.

    Each row also tells what a model would do that expects nothing to change: latent and reward stay where they were.
    """
    from latentplan.agents.checkpoint import load_agent

    agent: Any = load_agent(trial.checkpoint, mode="actor", device=trial.device)
    parts = [_prediction_errors(agent.model, *_record(agent, trial.env, seed)) for seed in trial.seeds]
    parts = [part for part in parts if part.shape[1]]
    if not parts:
        return
    errors = np.concatenate(parts, axis=1).mean(axis=1)
    names = ("latent_distance", "reward_error", "latent_change", "reward_change")
    for step, values in enumerate(errors.tolist(), start=1):
        yield {"step": step, **dict(zip(names, values, strict=True))}


def _record(agent: Any, env: SuiteEnv, seed: int) -> tuple[list[Any], list[np.ndarray], list[float]]:
    """Beliefs, the actions taken at them, and the rewards that arrived with the next."""
    from latentplan.models.symmetry import first_turn

    beliefs, actions, rewards = [], [], []
    agent.reset()
    frame, _ = env.reset(seed=seed)
    over = False
    while not over:
        action = agent.act(frame)
        beliefs.append(first_turn(agent.state))
        actions.append(action)
        frame, reward, terminated, truncated, _ = env.step(action)
        rewards.append(reward)
        over = terminated or truncated
    return beliefs, actions, rewards


def _prediction_errors(model: Any, beliefs: list[Any], actions: list[np.ndarray], rewards: list[float]) -> np.ndarray:
    """(step, start, quantity): latent distance, reward error, and the same of expecting no change."""
    import torch

    steps = min(IMAGINED_STEPS, len(beliefs) - 2)
    starts = torch.arange(1, len(beliefs) - steps, START_EVERY)
    taken = torch.as_tensor(np.stack(actions), device=model.device)
    earned = torch.tensor(rewards, device=model.device)
    seen = torch.cat([belief.stoch for belief in beliefs])
    state = type(beliefs[0])(*(torch.cat(parts)[starts] for parts in zip(*beliefs, strict=True)))
    rows = []
    with torch.no_grad():
        for step in range(steps):
            state, reward = model.step(state, taken[starts + step])
            after, arrived = seen[starts + step + 1], earned[starts + step]
            columns = (
                (state.stoch - after).norm(dim=-1),
                (reward - arrived).abs(),
                (seen[starts] - after).norm(dim=-1),
                (earned[starts - 1] - arrived).abs(),
            )
            rows.append(torch.stack([column.float().cpu() for column in columns], dim=-1))
    return torch.stack(rows).numpy() if rows else np.zeros((0, 0, 4))


def _mean_decision_ms(episodes: Sequence[TimedEpisode]) -> float:
    return float(np.mean(np.concatenate([episode.decision_ms for episode in episodes])))
