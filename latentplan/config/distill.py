"""Settings of distillation."""

from __future__ import annotations

from dataclasses import dataclass

from latentplan.config.checks import above_zero, at_least, within


@dataclass(frozen=True)
class DistillConfig:
    """Teaching the actor what the planner does.

    Attributes:
        rounds: Rounds of driving, labelling and learning.
        episodes: Episodes driven per round.
        minutes: No round begins after so many minutes; None leaves it to `rounds`.
        planner_rounds: First rounds that the planner drives (behavioural cloning); in the others the actor does.
        updates: Updates of the actor per round.
        batch_size: Beliefs per update.
        learning_rate: Adam step of the actor.
        relabel_share: Share of the stored beliefs, those with the oldest labels, that each round plans again.
        plan_batch: Beliefs per call of the planner.
        evaluation_episodes: Episodes that choose between rounds; as many, on other starts, judge the one chosen.
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
