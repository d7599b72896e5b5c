"""Settings of distillation."""

from __future__ import annotations

from dataclasses import dataclass

from latentplan.config.checks import above_zero, at_least, within


@dataclass(frozen=True)
class DistillConfig:
    """Settings with which the actor learns to act as the planner (DAgger, Ross et al. 2011).

    Attributes:
        rounds: Rounds of collecting, training and selecting.
        episodes: Episodes collected per round.
        minutes: Minutes after which no further round begins; None sets no such limit.
        planner_rounds: First rounds, in which the planner acts (behavioural cloning); in later rounds the actor acts.
        updates: Updates of the actor per round.
        batch_size: Beliefs per update.
        learning_rate: Adam step of the actor.
        relabel_share: Share of the stored beliefs that each round plans again, oldest labels first, in [0, 1].
        plan_batch: Beliefs planned in one batch.
        evaluation_episodes: Episodes that select the best round, and also episodes, from other starts, that test it.
        seed: Seed of every random stream.
    """

    rounds: int = 10
    episodes: int = 4
    minutes: float | None = None
    planner_rounds: int = 1
    updates: int = 500
    batch_size: int = 256
    learning_rate: float = 1e-3
    relabel_share: float = 0.1
    plan_batch: int = 256
    evaluation_episodes: int = 10
    seed: int = 0

    def __post_init__(self) -> None:
        at_least(self, rounds=1, episodes=1, planner_rounds=0, updates=1, batch_size=1, plan_batch=1)
        at_least(self, evaluation_episodes=2, seed=0)
        above_zero(self, "minutes", "learning_rate")
        within(self, relabel_share=(0.0, 1.0))
