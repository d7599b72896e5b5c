"""Beliefs to learn goals from where no replay is left: an agent plays, for its task and for goals drawn at random."""

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

ROUND = 125  # decisions


def play(config: Config, model: WorldModel, decisions: int, seed: int, report: Callable[[int], None]) -> Replay:
    """What an agent sees that explores for its task, and in every other round pursues a box drawn at random.

    Args:
        config: Settings of the agent; its exploration noise is what it explores with.
        model: The agent's, with quantities.
        decisions: How many are played.
        seed: Of every random stream.
        report: Called after each round with the decisions so far.

    Returns:
        A replay of about so many rows.
    """
    alone = replace(config, env=replace(config.env, num_envs=1), run=replace(config.run, seed=seed))
    size = 2 * (decisions + ROUND)  # an episode has a row more than decisions
    replay = Replay(size, model.action_dim, model.config.deter_dim, 1, torch.device("cpu"), len(model.labels))
    collector = Collector(alone, None, "cpu")
    heads = [name for name in model.state_dict() if name.startswith("goal_heads.")]
    weights = {name: value.cpu().numpy() for name, value in model.state_dict().items() if name not in heads}
    generator = torch.Generator().manual_seed(derive_seed(seed, "play"))
    try:
        for counter in range(-(-decisions // ROUND)):
            goal = _draw_goal(model, replay, generator) if counter % 2 else None
            behaviour = "actor" if goal is None else "planner"
            collected = collector.collect(weights, behaviour, ROUND, counter, goal=goal)
            replay.add(0, collected.rows[0])
            report((counter + 1) * ROUND)
    finally:
        collector.close()
    return replay


def describe_box(names: Sequence[str], low: Sequence[float], high: Sequence[float]) -> str:
    """The expression that asks for a box, given by its ends."""
    clauses = []
    for name, least, most in zip(names, low, high, strict=True):
        if least == most:
            clauses.append(f"{name} -> {least:.6f}")
            continue
        clauses += [f"{name} > {least:.6f}"] if math.isfinite(least) else []
        clauses += [f"{name} < {most:.6f}"] if math.isfinite(most) else []
    return " and ".join(clauses)


def _draw_goal(model: WorldModel, replay: Replay, generator: torch.Generator) -> str:
    rows = np.flatnonzero(replay.episode.reshape(-1) >= 0)
    met = replay.labels[torch.from_numpy(rows)][:, : len(model.goal_names)]
    low, high, _ = BoxSource(met, model.goal_scales.cpu(), generator).draw(1, generator)
    return describe_box(model.goal_names, low[0].tolist(), high[0].tolist())
