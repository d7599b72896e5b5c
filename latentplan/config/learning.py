"""Settings of learning, and of collecting the experience that a run learns from."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

from latentplan.config.checks import MAX_EPISODES, above_zero, at_least, no_text, one_of, within
from latentplan.config.parsing import option

Behaviour = Literal["planner", "actor", "both"]
CollectionBackend = Literal["process", "ray"]
BEHAVIOURS = get_args(Behaviour)
COLLECTION_BACKENDS = get_args(CollectionBackend)
MAX_WORKERS = 256
MAX_UPDATES = 10**9
SYMLOG_LIMIT = 9.0  # of the bins of the reward head and the value head
LARGEST_SCALAR = math.exp(SYMLOG_LIMIT) - 1.0  # about 8,100; larger rewards and returns saturate
MAX_ROWS = 1_000_000  # of a batch, or of decisions that are kept in memory


@dataclass(frozen=True)
class LearningConfig:
    """Losses and optimizers.

    Attributes:
        batch_size: Sequences per update.
        sequence_length: Decisions per sequence.
        random_shift: Largest shift of a replayed sequence of frames, in pixels, in either direction of each axis.
        turned_share: Share of the replayed sequences that are turned by quarter turns, for a body that looks the same
            from every side, in [0, 1].
        model_learning_rate: Adam step of encoder, dynamics, decoder, reward head and continue head.
        behaviour_learning_rate: Adam step of actor and value.
        max_grad_norm: Gradient norm at which each optimizer clips.
        reconstruction_scale: Weight of the picture's squared error, which is divided by its own mean over the batch, so
            that small things on a plain ground count as much as a body that fills the picture.
        dynamics_scale: Weight of the KL that moves the prior towards the posterior.
        representation_scale: Weight of the KL that moves the posterior towards the prior.
        free_nats: KL in nats below which both KL losses have no gradient.
        overshooting_scale: Weight of the KL that moves open-loop predictions towards the posterior.
        overshooting_horizon: Decisions that an open-loop prediction spans.
        reward_scale: Weight of the reward loss.
        vector_scale: Weight of the squared error of each of the numbers that `env.vectors` names, which is divided by
            its own mean over the batch.
        imagination_horizon: Model steps of each imagined rollout.
        imagination_starts: Imagined rollouts per update; their starts are drawn from the states of the batch.
        gradient_decay: Share of the actor's gradient that each imagined step passes back to the step before, in [0, 1].
        lambda_: Mixing of n-step returns into the lambda-return, in [0, 1].
        discount: Discount per decision; None derives 1 - 5 / (decisions per episode).
        replay_value_scale: Weight of the value loss on replayed rewards, beside the loss on imagined rewards.
        entropy_scale: Weight of the actor's entropy, in units of the normalised return per nat.
        target_rate: Share of the value network's weights that the slow target network takes at each update.
        average_rate: Smallest weight of the latest update in the averaged weights, which act, are evaluated and are
            saved: 0.01 averages over about a hundred updates (fewer early on), 1 turns averaging off.
        curriculum_task: Task of the same domain, or expression over its quantities such as `upright`, whose reward is
            learned first; None starts with the reward of the run's own task or `env.objective`.
        curriculum_frames: Simulator frames with the reward of `curriculum_task`, counted before action repeat.
        cuda_graph: Whether an update on a GPU is recorded once as a CUDA graph and replayed, which needs
            `replay.on_device`. The setting has no effect on a CPU.
    """

    batch_size: int = 16
    sequence_length: int = 16
    random_shift: int = 4
    turned_share: float = 0.0
    model_learning_rate: float = 1e-3
    behaviour_learning_rate: float = 3e-4
    max_grad_norm: float = 100.0
    reconstruction_scale: float = 30.0
    dynamics_scale: float = 1.0
    representation_scale: float = 0.5
    free_nats: float = 1.0
    overshooting_scale: float = 0.1
    overshooting_horizon: int = 8
    reward_scale: float = 1.0
    vector_scale: float = 2.0
    imagination_horizon: int = 15
    imagination_starts: int = 128
    gradient_decay: float = 0.9
    lambda_: float = 0.95
    discount: float | None = None
    replay_value_scale: float = 0.3
    entropy_scale: float = 3e-3
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
        at_least(
            self, overshooting_scale=0.0, reward_scale=0.0, vector_scale=0.0, replay_value_scale=0.0, entropy_scale=0.0
        )
        at_least(self, curriculum_frames=0)
        within(self, random_shift=(0, 64))
        above_zero(
            self, "model_learning_rate", "behaviour_learning_rate", "max_grad_norm", "target_rate", "average_rate"
        )
        within(self, gradient_decay=(0.0, 1.0), lambda_=(0.0, 1.0))
        within(self, turned_share=(0.0, 1.0), target_rate=(0.0, 1.0), average_rate=(0.0, 1.0))
        if self.discount is not None and not 0.0 < self.discount <= 1.0:
            raise ValueError(f"discount must lie in (0, 1], got {self.discount}")


@dataclass(frozen=True)
class CollectionConfig:
    """Collection of experience, and the number of updates per collected decision.

    Attributes:
        behaviour: Agent that acts while collecting: the planner, the actor, or both in alternate rounds.
        noise_std: Standard deviation of the noise added to the planner's action, in action units.
        noise_correlation: Correlation of the planner's and the actor's noise between one decision and the next, in
            [0, 0.99].
        goals: Expressions such as `speed -> 2.0 and height > 1.1` that the planner pursues in turn in some rounds, so
            that the model also learns about states away from the reward.
        goal_share: Share of all rounds in which the planner pursues a goal; `behaviour` divides the other rounds.
        goals_after: Simulator frames collected before the first round with a goal.
        episode_decisions: Decisions after which a short episode is cut; null takes 50, or `learning.sequence_length` if
            that is more. Short episodes show more starts. Evaluations are never cut.
        short_share: Share of the decisions that are collected in short episodes, in [0, 1].
        prefill_decisions: Random decisions before learning starts.
        round_decisions: Decisions of a round; a round is collected, then learned from.
        updates_per_decision: Updates per collected decision (the replay ratio, in updates).
        overlap: Whether the next round is collected in another process, on the CPU, while this round is learned from.
        backend: How collection processes are started: `process` on this machine, or `ray` on the machines of a Ray
            cluster. Needs `latentplan[ray]`.
        workers: Collection processes that share each round and the episodes of each evaluation, in [1, 256]. Each has
            `env.num_envs` environments.
        asynchronous: Whether a round ends as soon as enough decisions have arrived, from any of the workers. A slow
            worker then delays no round, but the results depend on the speed of the workers.
        max_restarts: Restarts of environments that fail (an exception, a crash, a hang, a frame or reward that is not
            as declared) before the run saves and stops. Each fault cuts one episode short.
        step_timeout_s: Seconds that a reset or a step may take of an environment in a process of its own: of several
            environments, and of one that is not of `dm_control` while `overlap` holds.
        enabled: Whether the run collects. Without collection it learns from `replay.demonstrations` alone, and plays
            episodes only to evaluate.
        keep_episodes: Folder for every collected episode, one HDF5 file each, which `replay.demonstrations` reads;
            None keeps none. Needs `latentplan[data]`.
    """

    behaviour: Behaviour = "both"
    noise_std: float = 0.4
    noise_correlation: float = 0.5
    goals: tuple[str, ...] = ()
    goal_share: float = 0.0
    goals_after: int = 0
    episode_decisions: int | None = None
    short_share: float = 0.5
    prefill_decisions: int = 1000
    round_decisions: int = 250
    updates_per_decision: float = 0.5
    overlap: bool = True
    backend: CollectionBackend = "process"
    workers: int = 1
    asynchronous: bool = False
    max_restarts: int = 10
    step_timeout_s: float = 60.0
    enabled: bool = True
    keep_episodes: str | None = option(None, metavar="DIR")

    def __post_init__(self) -> None:
        no_text(self, "goals")
        one_of(self, behaviour=BEHAVIOURS, backend=COLLECTION_BACKENDS)
        within(self, workers=(1, MAX_WORKERS))
        at_least(self, noise_std=0.0, prefill_decisions=1, round_decisions=1, goals_after=0)
        within(self, noise_correlation=(0.0, 0.99), goal_share=(0.0, 1.0))
        if self.goal_share > 0.0 and not self.goals:
            raise ValueError("goal_share needs goals; name at least one expression in collection.goals")
        if self.goals and self.goal_share == 0.0:
            raise ValueError("goals need a goal_share above 0: the share of rounds in which they are pursued")
        at_least(self, max_restarts=0)
        within(self, step_timeout_s=(0.01, 86_400.0), short_share=(0.0, 1.0))
        above_zero(self, "updates_per_decision", "episode_decisions")


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
        at_least(self, planner_rounds=0, seed=0)
        within(self, rounds=(1, MAX_EPISODES), episodes=(1, MAX_EPISODES), evaluation_episodes=(2, MAX_EPISODES))
        within(self, updates=(1, MAX_UPDATES), batch_size=(1, MAX_ROWS), plan_batch=(1, MAX_ROWS))
        above_zero(self, "minutes", "learning_rate")
        within(self, relabel_share=(0.0, 1.0))


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
        at_least(self, seed=0, entropy_scale=0.0)
        within(self, updates=(1, MAX_UPDATES), starts=(1, MAX_ROWS), play_decisions=(1, MAX_ROWS))
        within(self, horizon=(1, 10_000), hidden_dim=(1, 16_384))
        above_zero(self, "minutes", "learning_rate")
