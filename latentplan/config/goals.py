"""Settings of goal conditioning."""

from __future__ import annotations

from dataclasses import dataclass

from latentplan.config.checks import above_zero, at_least


@dataclass(frozen=True)
class GoalsConfig:
    """Settings with which a trained agent learns to pursue goals that are named after training.

    Attributes:
        updates: Total number of updates.
        minutes: Minutes after which no further update begins; None sets no such limit.
        starts: Imagined rollouts per update, each from its own replayed belief and for its own goal.
        horizon: Model steps of each rollout.
        hidden_dim: Width of the hidden layers of goal actor and goal value.
        learning_rate: Adam step of goal actor and goal value.
        entropy_scale: Weight of the actor's entropy in nats, in units of the spread of returns.
        play_decisions: Decisions that an agent without the replay of its run plays first.
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
