"""Settings of goal-conditioned learning, after which an agent pursues goals that are named later."""

from __future__ import annotations

from dataclasses import dataclass

from latentplan.config.checks import above_zero, at_least
from latentplan.config.parsing import option


@dataclass(frozen=True)
class GoalsConfig:
    """Goal-conditioned learning: a trained agent learns to pursue goals that are named later.

    Attributes:
        updates: Updates in total.
        minutes: Minutes after which no update begins; None sets no limit.
        starts: Imagined rollouts per update, each from a replayed belief and for a goal of its own.
        horizon: Model steps of an imagined rollout.
        hidden_dim: Width of the hidden layers of the actor and the value.
        learning_rate: Adam step of the actor and the value.
        entropy_scale: Weight of the actor's entropy, in units of the spread of returns per nat.
        play_decisions: Decisions that the agent first plays where the replay of its run is missing.
        seed: Seed of every random stream.
    """

    updates: int = 50_000
    minutes: float | None = None
    starts: int = 320
    horizon: int = 12
    hidden_dim: int = option(48, is_rare=True)
    learning_rate: float = option(1e-3, is_rare=True)
    entropy_scale: float = option(1e-3, is_rare=True)
    play_decisions: int = 10_000
    seed: int = 0

    def __post_init__(self) -> None:
        at_least(self, updates=1, starts=1, horizon=1, hidden_dim=1, play_decisions=1, seed=0, entropy_scale=0.0)
        above_zero(self, "minutes", "learning_rate")
