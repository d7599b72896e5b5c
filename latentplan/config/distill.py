"""Settings of distillation, in which an actor learns to act as its planner does."""

from __future__ import annotations

from dataclasses import dataclass

from latentplan.config.checks import above_zero, at_least, within
from latentplan.config.parsing import option


@dataclass(frozen=True)
class DistillConfig:
    """Distillation: an actor learns to act as its planner does.

    Attributes:
        rounds: Rounds; each plays episodes, has the planner label their beliefs, and trains the actor on the labels.
        episodes: Episodes played per round.
        minutes: Minutes after which no round begins; None sets no limit.
        planner_rounds: First rounds in which the planner acts (behavioural cloning); in later rounds the actor acts.
        updates: Updates of the actor per round.
        batch_size: Beliefs per update.
        learning_rate: Adam step of the actor.
        relabel_share: Share of the stored beliefs that each round labels again, those with the oldest labels first.
        plan_batch: Beliefs per call of the planner.
        evaluation_episodes: Episodes by which the best round is chosen; the chosen actor is then measured by the same
            number of episodes from other starts.
        seed: Seed of every random stream.
    """

    rounds: int = 10
    episodes: int = 4
    minutes: float | None = None
    planner_rounds: int = option(1, is_rare=True)
    updates: int = 500
    batch_size: int = option(256, is_rare=True)
    learning_rate: float = option(1e-3, is_rare=True)
    relabel_share: float = option(0.1, is_rare=True)
    plan_batch: int = option(256, is_rare=True)
    evaluation_episodes: int = 10
    seed: int = 0

    def __post_init__(self) -> None:
        at_least(self, rounds=1, episodes=1, planner_rounds=0, updates=1, batch_size=1, plan_batch=1)
        at_least(self, evaluation_episodes=2, seed=0)
        above_zero(self, "minutes", "learning_rate")
        within(self, relabel_share=(0.0, 1.0))
