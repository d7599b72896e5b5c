"""A replay for goal learning of an agent without one: the agent plays for its task and for random goals."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch

from latentplan.config import Config, derive_seed
from latentplan.models import WorldModel
from latentplan.replay.buffer import Replay
from latentplan.training.collection.collector import Collector
from latentplan.training.goal_conditioning.learner import BoxSource

ROUND_DECISIONS = 125


def play(config: Config, model: WorldModel, decisions: int, seed: int, report: Callable[[int], None]) -> Replay:
    """Plays with an agent: the actor explores for the agent's task in one round, the planner pursues a box in the next.

    Args:
        config: Settings of the agent, with its exploration noise.
        model: World model of the agent, which predicts quantities.
        decisions: Decisions to play, rounded up to whole rounds of 125.
        seed: Seed of every random stream.
        report: Called after each round with the number of decisions so far.

    Returns:
        A replay with one row per decision, and one more per episode.
    """
    single = replace(config, env=replace(config.env, num_envs=1), run=replace(config.run, seed=seed))
    size = 2 * (decisions + ROUND_DECISIONS)  # an episode has one row more than decisions
    replay = Replay(size, model.action_dim, model.config.deter_dim, 1, torch.device("cpu"), len(model.labels))
    collector = Collector(single, None, "cpu")
    heads = [name for name in model.state_dict() if name.startswith("goal_heads.")]
    weights = {name: value.cpu().numpy() for name, value in model.state_dict().items() if name not in heads}
    generator = torch.Generator().manual_seed(derive_seed(seed, "play"))
    try:
        for counter in range(-(-decisions // ROUND_DECISIONS)):
            goal = _draw_goal(model, replay, generator) if counter % 2 else None
            behaviour = "actor" if goal is None else "planner"
            collected = collector.collect(weights, behaviour, ROUND_DECISIONS, counter, goal=goal)
            replay.add(0, collected.rows[0])
            report((counter + 1) * ROUND_DECISIONS)
    finally:
        collector.close()
    return replay


def describe_box(names: Sequence[str], low: Sequence[float], high: Sequence[float]) -> str:
    """The objective expression of a box, such as `speed > 1.0 and speed < 2.0`, from the ends of its intervals."""
    clauses = []
    for name, least, most in zip(names, low, high, strict=True):
        if least == most:
            clauses.append(f"{name} -> {least:.6f}")
            continue
        clauses += [f"{name} > {least:.6f}"] if math.isfinite(least) else []
        clauses += [f"{name} < {most:.6f}"] if math.isfinite(most) else []
    return " and ".join(clauses)


def _draw_goal(model: WorldModel, replay: Replay, generator: torch.Generator) -> str:
    """An expression for a random box around the quantities observed so far."""
    rows = np.flatnonzero(replay.episode.reshape(-1) >= 0)
    observed = replay.labels[torch.from_numpy(rows)][:, : len(model.goal_names)]
    low, high, _ = BoxSource(observed, model.goal_scales.cpu(), generator).draw(1, generator)
    return describe_box(model.goal_names, low[0].tolist(), high[0].tolist())
