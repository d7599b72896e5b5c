"""Every setting of latentplan, one frozen dataclass per component.

Defaults are the recommended values. Bad values raise `ValueError` naming the field. This module
imports nothing but the standard library, so that every layer and the command line can read it.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

from latentplan.config.checks import UserError, above_zero, at_least, derive_seed, one_of, within
from latentplan.config.distill import DistillConfig
from latentplan.config.planner import PlannerConfig

__all__ = [
    "Config",
    "CollectionConfig",
    "DistillConfig",
    "EnvConfig",
    "EvaluationConfig",
    "LearningConfig",
    "ModelConfig",
    "PlannerConfig",
    "ReplayConfig",
    "RunConfig",
    "UserError",
    "derive_seed",
    "from_dict",
    "to_dict",
]

LATENT_DIM = 32
RENDER_QUALITIES = ("exact", "fast", "fastest")
BEHAVIOURS = ("planner", "actor", "both")
DEVICES = ("auto", "cpu", "cuda")


@dataclass(frozen=True)
class EnvConfig:
    """What is controlled, and how it is seen.

    Attributes:
        domain: Domain of `dm_control.suite`.
        task: Task of the domain; None picks the domain's usual one.
        action_repeat: Simulator control steps per decision.
        camera: Camera id of the MuJoCo model.
        render_quality: `exact` (dm_control's default), `fast` (small shadow map) or `fastest`
            (no shadows, reflections or anti-aliasing: a visibly easier picture).
        num_envs: Environments that collect at once; more than one runs each in its own process.
        objective: Expression over the body's quantities that pays in place of the task's reward, once per control step,
            such as `speed -> 2.0 and height > 1.1`; None leaves the task's.
    """

    domain: str = "walker"
    task: str | None = None
    action_repeat: int = 2
    camera: int = 0
    render_quality: str = "fast"
    num_envs: int = 1
    objective: str | None = None

    def __post_init__(self) -> None:
        at_least(self, action_repeat=1, num_envs=1, camera=-1)
        one_of(self, render_quality=RENDER_QUALITIES)


@dataclass(frozen=True)
class ModelConfig:
    """Sizes of the world model and its heads.

    Attributes:
        latent_dim: Size of the stochastic latent, the space in which the planner searches.
        deter_dim: Size of the GRU state.
        hidden_dim: Width of the hidden layers of every head.
        encoder_channels: Channels of the encoder's layers: the first reads 4 x 4 patches, each other halves the grid.
        decoder_channels: Channels of the decoder's 8 x 8 grid of tokens.
        num_bins: Bins of the distributional reward and value heads.
    """

    latent_dim: int = LATENT_DIM
    deter_dim: int = 192
    hidden_dim: int = 192
    encoder_channels: tuple[int, ...] = (32, 48, 64)
    decoder_channels: int = 16
    num_bins: int = 63

    def __post_init__(self) -> None:
        at_least(self, latent_dim=1, deter_dim=1, hidden_dim=1, decoder_channels=1, num_bins=3)
        if not 1 <= len(self.encoder_channels) <= 5 or min(self.encoder_channels) < 1:
            raise ValueError(f"encoder_channels must hold 1 to 5 positive sizes, got {self.encoder_channels}")


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
        lambda_: Mixing of n-step returns into the lambda-return, in [0, 1].
        discount: Discount per decision; None derives 1 - 5 / (decisions per episode).
        replay_value_scale: Weight of the value loss on replayed rewards beside the imagined one.
        entropy_scale: Weight of the actor's entropy, in units of the normalised return.
        imitation_scale: Weight of the actor's KL to the plans it was collected with; 0 leaves it out.
        target_rate: Share of the value network that its slow target takes over at each update.
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
    imagination_horizon: int = 10
    imagination_starts: int = 160
    lambda_: float = 0.95
    discount: float | None = None
    replay_value_scale: float = 0.3
    entropy_scale: float = 3e-4
    imitation_scale: float = 0.0
    target_rate: float = 0.02

    def __post_init__(self) -> None:
        at_least(
            self, batch_size=1, sequence_length=1, imagination_horizon=1, imagination_starts=1, overshooting_horizon=1
        )
        at_least(self, reconstruction_scale=0.0, dynamics_scale=0.0, representation_scale=0.0, free_nats=0.0)
        at_least(self, overshooting_scale=0.0, reward_scale=0.0, replay_value_scale=0.0, entropy_scale=0.0)
        at_least(self, imitation_scale=0.0, random_shift=0)
        above_zero(self, "model_learning_rate", "behaviour_learning_rate", "max_grad_norm", "target_rate")
        within(self, lambda_=(0.0, 1.0), turned_share=(0.0, 1.0), target_rate=(0.0, 1.0))
        if self.discount is not None and not 0.0 < self.discount <= 1.0:
            raise ValueError(f"discount must lie in (0, 1], got {self.discount}")


@dataclass(frozen=True)
class CollectionConfig:
    """How experience is gathered, and how much is learned from it.

    Attributes:
        behaviour: Who acts while collecting: `planner`, `actor`, or `both` in alternate rounds.
        noise_std: Standard deviation of the noise added to the planner's action.
        noise_correlation: Of the planner's and the actor's noise between one decision and the next, in [0, 1).
        noise_share: Share of the rounds with that noise; in the others planner and actor act as they are evaluated.
        episode_decisions: After how many a collected episode is cut short; None plays on. Evaluations are whole.
        prefill_decisions: Random decisions before learning starts.
        round_decisions: Decisions per epoch: this many are collected, then learned from.
        updates_per_decision: Updates per collected decision (the replay ratio, in updates).
        overlap: Whether the next round is collected in another process while this one is learned from.
    """

    behaviour: str = "planner"
    noise_std: float = 0.2
    noise_correlation: float = 0.0
    noise_share: float = 1.0
    episode_decisions: int | None = None
    prefill_decisions: int = 1000
    round_decisions: int = 250
    updates_per_decision: float = 0.5
    overlap: bool = True

    def __post_init__(self) -> None:
        one_of(self, behaviour=BEHAVIOURS)
        at_least(self, noise_std=0.0, prefill_decisions=1, round_decisions=1)
        within(self, noise_correlation=(0.0, 0.99), noise_share=(0.0, 1.0))
        above_zero(self, "updates_per_decision", "episode_decisions")


@dataclass(frozen=True)
class ReplayConfig:
    """Where experience is kept.

    Attributes:
        capacity: Decisions kept; None holds the whole run when its length is known, else 200,000.
        on_device: Whether the frames live on the training device instead of in main memory.
    """

    capacity: int | None = None
    on_device: bool = False

    def __post_init__(self) -> None:
        above_zero(self, "capacity")


@dataclass(frozen=True)
class EvaluationConfig:
    """When the agent is measured while it learns.

    Attributes:
        every_frames: Simulator frames between evaluations.
        episodes: Paired episodes of planner and actor per evaluation during training.
        final_episodes: Episodes of the evaluation that ends a run.
        video: Whether each evaluation films its first episode.
    """

    every_frames: int = 10_000
    episodes: int = 2
    final_episodes: int = 10
    video: bool = True

    def __post_init__(self) -> None:
        at_least(self, every_frames=1, episodes=1, final_episodes=1)


@dataclass(frozen=True)
class RunConfig:
    """One training run.

    Attributes:
        frames: Simulator frames to train for (counted before action repeat); None leaves it to `minutes`.
        minutes: Minutes of wall clock to train for; None leaves it to `frames`.
        seed: Seed of every random stream of the run.
        device: `auto`, `cpu` or `cuda`.
        threads: CPU threads for learning; None takes every core but the one that collects.
        run_dir: Folder of the run; None makes `runs/<domain>-<task>-<date>`.
    """

    frames: int | None = None
    minutes: float | None = None
    seed: int = 0
    device: str = "auto"
    threads: int | None = None
    run_dir: str | None = None

    def __post_init__(self) -> None:
        one_of(self, device=DEVICES)
        at_least(self, seed=0)
        above_zero(self, "frames", "minutes", "threads")


@dataclass(frozen=True)
class Config:
    """Everything that defines a run."""

    env: EnvConfig = field(default_factory=EnvConfig)
    model: ModelConfig = field(default_factory=ModelConfig)
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    learning: LearningConfig = field(default_factory=LearningConfig)
    collection: CollectionConfig = field(default_factory=CollectionConfig)
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    run: RunConfig = field(default_factory=RunConfig)


def to_dict(config: Any) -> dict[str, Any]:
    """The settings as plain nested dictionaries, tuples as lists (for YAML and JSON)."""
    return {
        name: to_dict(value) if dataclasses.is_dataclass(value) else list(value) if isinstance(value, tuple) else value
        for name, value in ((f.name, getattr(config, f.name)) for f in dataclasses.fields(config))
    }


def from_dict(values: dict[str, Any]) -> Config:
    """The inverse of `to_dict`; absent fields take their defaults.

    Raises:
        ValueError: A section or field is unknown, or a value is not allowed.
    """
    sections = {f.name: f.default_factory for f in dataclasses.fields(Config)}
    built = {}
    for section, settings in values.items():
        if section not in sections:
            raise ValueError(f"unknown section {section!r}; available: {', '.join(sections)}")
        kind: Any = sections[section]
        names = {f.name for f in dataclasses.fields(kind)}
        for name in settings:
            if name not in names:
                raise ValueError(f"unknown setting {section}.{name}; available: {', '.join(sorted(names))}")
        built[section] = kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in settings.items()})
    return Config(**built)
