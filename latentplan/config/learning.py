"""Settings of learning, and of gathering what is learned from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from latentplan.config.checks import above_zero, at_least, one_of, within

Behaviour = Literal["planner", "actor", "both"]
BEHAVIOURS = get_args(Behaviour)


@dataclass(frozen=True)
class LearningConfig:
    """Losses and optimizers.

    Attributes:
        batch_size: Sequences per update.
        sequence_length: Decisions per sequence.
        random_shift: Pixels by which each replayed sequence of frames is moved at most, in either direction.
        turned_share: Of the replayed sequences, turned by quarter turns; for a body to which every side is the same.
        model_learning_rate: Adam step of encoder, dynamics, decoder, reward and continue heads.
        behaviour_learning_rate: Adam step of actor and value.
        max_grad_norm: Gradient norm at which each optimizer clips.
        reconstruction_scale: Weight of the squared error summed over the 32 x 32 picture.
        dynamics_scale: Weight of the KL that pulls the prior to the posterior.
        representation_scale: Weight of the KL that pulls the posterior to the prior.
        free_nats: KL below which neither is pulled.
        overshooting_scale: Weight of the KL that pulls open-loop predictions to what was seen.
        overshooting_horizon: Decisions that open-loop predictions reach.
        reward_scale: Weight of the reward loss.
        imagination_horizon: Model steps of each imagined rollout.
        imagination_starts: Rollouts imagined per update, drawn from the batch's states.
        gradient_decay: Share of the actor's gradient that each imagined step passes back to the one before, in [0, 1].
        lambda_: Mixing of n-step returns into the lambda-return, in [0, 1].
        discount: Discount per decision; None derives 1 - 5 / (decisions per episode).
        replay_value_scale: Weight of the value loss on replayed rewards beside the imagined one.
        entropy_scale: Weight of the actor's entropy, in units of the normalised return.
        target_rate: Share of the value network that its slow target takes over at each update.
        average_rate: Least weight of the latest update in the average of the weights that acts, is judged and is kept:
            0.01 averages over some hundred updates (early on over fewer), 1 over none.
        curriculum_task: Task of the same domain, or expression over its quantities such as `upright`, whose reward is
            learned first, on the way to the run's own task or `env.objective`; None starts with that.
        curriculum_frames: Simulator frames of the run for which it is, counted before action repeat.
        cuda_graph: Whether an update on a GPU is recorded once, as a CUDA graph, and replayed; needs
            `replay.on_device`. On a CPU it changes nothing.
    """

    batch_size: int = 16
    sequence_length: int = 16
    random_shift: int = 0
    turned_share: float = 0.0
    model_learning_rate: float = 1e-3
    behaviour_learning_rate: float = 3e-4
    max_grad_norm: float = 100.0
    reconstruction_scale: float = 4.0
    dynamics_scale: float = 1.0
    representation_scale: float = 0.1
    free_nats: float = 1.0
    overshooting_scale: float = 0.1
    overshooting_horizon: int = 8
    reward_scale: float = 1.0
    imagination_horizon: int = 15
    imagination_starts: int = 128
    gradient_decay: float = 1.0
    lambda_: float = 0.95
    discount: float | None = None
    replay_value_scale: float = 0.3
    entropy_scale: float = 1e-3
    target_rate: float = 0.02
    average_rate: float = 0.01
    curriculum_task: str | None = None
    curriculum_frames: int = 0
    cuda_graph: bool = False

    def __post_init__(self) -> None:
        at_least(
            self, batch_size=1, sequence_length=1, imagination_horizon=1, imagination_starts=1, overshooting_horizon=1
        )
        at_least(self, reconstruction_scale=0.0, dynamics_scale=0.0, representation_scale=0.0, free_nats=0.0)
        at_least(self, overshooting_scale=0.0, reward_scale=0.0, replay_value_scale=0.0, entropy_scale=0.0)
        at_least(self, random_shift=0, curriculum_frames=0)
        above_zero(
            self, "model_learning_rate", "behaviour_learning_rate", "max_grad_norm", "target_rate", "average_rate"
        )
        within(self, gradient_decay=(0.0, 1.0), lambda_=(0.0, 1.0))
        within(self, turned_share=(0.0, 1.0), target_rate=(0.0, 1.0), average_rate=(0.0, 1.0))
        if self.discount is not None and not 0.0 < self.discount <= 1.0:
            raise ValueError(f"discount must lie in (0, 1], got {self.discount}")


@dataclass(frozen=True)
class CollectionConfig:
    """How experience is gathered, and how much is learned from it.

    Attributes:
        behaviour: Who acts while collecting: `planner`, `actor`, or `both` in alternate rounds.
        noise_std: Standard deviation of the noise added to the planner's action.
        noise_correlation: Of the planner's and the actor's noise between one decision and the next, in [0, 1).
        goals: Expressions such as `speed -> 2.0 and height > 1.1` that the planner pursues in turn in some rounds, so
            that the model knows more than the way to the reward.
        goal_share: Share of all rounds in which it does; planner and actor have the others.
        goals_after: Simulator frames collected before the first of them.
        episode_decisions: After how many a collected episode is cut short; None plays on. Evaluations are whole.
        prefill_decisions: Random decisions before learning starts.
        round_decisions: Decisions per epoch: this many are collected, then learned from.
        updates_per_decision: Updates per collected decision (the replay ratio, in updates).
        overlap: Whether the next round is collected in another process, on the CPU, while this one is learned from.
    """

    behaviour: Behaviour = "both"
    noise_std: float = 0.4
    noise_correlation: float = 0.5
    goals: tuple[str, ...] = ()
    goal_share: float = 0.0
    goals_after: int = 0
    episode_decisions: int | None = None
    prefill_decisions: int = 1000
    round_decisions: int = 250
    updates_per_decision: float = 0.5
    overlap: bool = True

    def __post_init__(self) -> None:
        one_of(self, behaviour=BEHAVIOURS)
        at_least(self, noise_std=0.0, prefill_decisions=1, round_decisions=1, goals_after=0)
        within(self, noise_correlation=(0.0, 0.99), goal_share=(0.0, 1.0))
        if self.goal_share > 0.0 and not self.goals:
            raise ValueError("goal_share needs goals; name at least one expression in collection.goals")
        if self.goals and self.goal_share == 0.0:
            raise ValueError("goals need a goal_share above 0: the share of rounds in which they are pursued")
        above_zero(self, "updates_per_decision", "episode_decisions")
