"""Settings of learning goals."""

from __future__ import annotations

from dataclasses import dataclass

from latentplan.config.checks import above_zero, at_least


@dataclass(frozen=True)
class GoalsConfig:
    """Teaching a trained agent to pursue goals that are named later.

    Attributes:
        updates: Updates in all.
        minutes: No update begins after so many minutes; None leaves it to `updates`.
        starts: Imagined rollouts per update, each from a replayed belief and for a goal of its own.
        horizon: Steps of each.
        hidden_dim: Width of the hidden layers of the actor and the value.
        learning_rate: Adam step of both.
        entropy_scale: What a nat of the actor's entropy counts, of the spread of returns.
        play_decisions: Decisions that the agent plays to begin from, where it comes without the replay of its run.
        seed: Seed of every random stream.
    """

    updates: int = 50_000
    minutes: float | None = None
    starts: int = 320
    horizon: int = 12
    hidden_dim: int = 48
    learning_rate: float = 1e-3
    entropy_scale: float = 1e-3
    play_decisions: int = 10_000
    seed: int = 0

    def __post_init__(self) -> None:
        at_least(self, updates=1, starts=1, horizon=1, hidden_dim=1, play_decisions=1, seed=0, entropy_scale=0.0)
        above_zero(self, "minutes", "learning_rate")
