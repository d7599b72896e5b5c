"""Every setting of latentplan, one frozen dataclass per component.

Defaults are the recommended values. Bad values raise `ValueError` naming the field. This module
imports nothing but the standard library, so that every layer and the command line can read it.
"""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import dataclass, field
from typing import Any

LATENT_DIM = 32
RENDER_QUALITIES = ("exact", "fast", "fastest")
BEHAVIOURS = ("planner", "actor", "both")
DEVICES = ("auto", "cpu", "cuda")


class UserError(ValueError):
    """Something the user gave cannot work; the message is one line that says what to give instead."""


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
    """

    domain: str = "walker"
    task: str | None = None
    action_repeat: int = 2
    camera: int = 0
    render_quality: str = "fast"
    num_envs: int = 1

    def __post_init__(self) -> None:
        _at_least(self, action_repeat=1, num_envs=1, camera=-1)
        _one_of(self, render_quality=RENDER_QUALITIES)


@dataclass(frozen=True)
class ModelConfig:
    """Sizes of the world model and its heads.

    Attributes:
        latent_dim: Size of the stochastic latent, the space in which the planner searches.
        deter_dim: Size of the GRU state.
        hidden_dim: Width of the hidden layers of every head.
        encoder_channels: Channels of the encoder's layers: the first reads 4 x 4 patches, each later one halves the grid.
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
        _at_least(self, latent_dim=1, deter_dim=1, hidden_dim=1, decoder_channels=1, num_bins=3)
        if not 1 <= len(self.encoder_channels) <= 5 or min(self.encoder_channels) < 1:
            raise ValueError(f"encoder_channels must hold 1 to 5 positive sizes, got {self.encoder_channels}")


@dataclass(frozen=True)
class PlannerConfig:
    """CEM-MPC: the search over action sequences.

    Attributes:
        horizon: Model steps that a plan looks ahead.
        num_samples: Candidate sequences per iteration.
        num_elites: Best candidates that refit the search distribution.
        num_iterations: Refits of a cold start.
        warm_start_iterations: Refits when the last plan is handed on.
        smoothing: Weight of the new statistics in the Polyak update of mean and variance, in (0, 1].
        init_std: Standard deviation at the start of a search, in action units.
        min_std: Floor of the sampling standard deviation, in action units.
        num_policy_samples: Candidates proposed by the actor, its own mode first; 0 leaves the actor out.
        warm_start: Whether a search starts from the shifted last plan.
        terminal_value: Whether the value of the last imagined state completes the return.
        use_continues: Whether the predicted probability of going on discounts what follows.
        start: Centre of the search: `shifted` (the last plan), `policy` (the actor's) or `both`.
        tail: What fills the end of the shifted plan: `zero`, `hold` or `policy`.
        warm_start_variance: Variance of a warm start: `reset`, `keep` or `inflate`.
        final: What is executed: the `mean` of the distribution or the `best` candidate.
        noise_beta: Exponent of coloured sampling noise; 0 is white.
        keep_elite_fraction: Share of the elites kept for the next iteration and the next plan.
    """

    horizon: int = 6
    num_samples: int = 256
    num_elites: int = 32
    num_iterations: int = 4
    warm_start_iterations: int = 3
    smoothing: float = 0.9
    init_std: float = 0.5
    min_std: float = 0.05
    num_policy_samples: int = 24
    warm_start: bool = True
    terminal_value: bool = True
    use_continues: bool = False
    start: str = "shifted"
    tail: str = "zero"
    warm_start_variance: str = "reset"
    final: str = "mean"
    noise_beta: float = 0.0
    keep_elite_fraction: float = 0.0

    def __post_init__(self) -> None:
        _at_least(self, horizon=1, num_samples=2, num_elites=1, num_iterations=1, warm_start_iterations=1)
        _at_least(self, num_policy_samples=0, init_std=0.0, min_std=0.0, noise_beta=0.0)
        _within(self, smoothing=(0.0, 1.0), keep_elite_fraction=(0.0, 1.0))
        _one_of(self, start=("shifted", "policy", "both"), tail=("zero", "hold", "policy"))
        _one_of(self, warm_start_variance=("reset", "keep", "inflate"), final=("mean", "best"))
        for name in ("num_elites", "num_policy_samples"):
            if getattr(self, name) > self.num_samples - (name == "num_policy_samples"):
                raise ValueError(f"{name} ({getattr(self, name)}) is too many for num_samples ({self.num_samples})")


@dataclass(frozen=True)
class LearningConfig:
    """Losses and optimizers.

    Attributes:
        batch_size: Sequences per update.
        sequence_length: Decisions per sequence.
        model_learning_rate: Adam step of encoder, dynamics, decoder, reward and continue heads.
        behaviour_learning_rate: Adam step of actor and value.
        max_grad_norm: Gradient norm at which each optimizer clips.
        reconstruction_scale: Weight of the squared error summed over the picture.
        dynamics_scale: Weight of the KL that pulls the prior to the posterior.
        representation_scale: Weight of the KL that pulls the posterior to the prior.
        free_nats: KL below which neither is pulled.
        reward_scale: Weight of the reward loss.
        imagination_horizon: Model steps of each imagined rollout.
        imagination_starts: Rollouts imagined per update, drawn from the batch's states.
        lambda_: Mixing of n-step returns into the lambda-return, in [0, 1].
        discount: Discount per decision; None derives 1 - 5 / (decisions per episode).
        replay_value_scale: Weight of the value loss on replayed rewards beside the imagined one.
        entropy_scale: Weight of the actor's entropy, in units of the normalised return.
        target_rate: Share of the value network that its slow target takes over at each update.
    """

    batch_size: int = 16
    sequence_length: int = 16
    model_learning_rate: float = 1e-3
    behaviour_learning_rate: float = 3e-4
    max_grad_norm: float = 100.0
    reconstruction_scale: float = 1.0
    dynamics_scale: float = 1.0
    representation_scale: float = 0.1
    free_nats: float = 1.0
    reward_scale: float = 1.0
    imagination_horizon: int = 10
    imagination_starts: int = 160
    lambda_: float = 0.95
    discount: float | None = None
    replay_value_scale: float = 0.3
    entropy_scale: float = 3e-4
    target_rate: float = 0.02

    def __post_init__(self) -> None:
        _at_least(self, batch_size=1, sequence_length=1, imagination_horizon=1, imagination_starts=1)
        _at_least(self, reconstruction_scale=0.0, dynamics_scale=0.0, representation_scale=0.0, free_nats=0.0)
        _at_least(self, reward_scale=0.0, replay_value_scale=0.0, entropy_scale=0.0)
        _above_zero(self, "model_learning_rate", "behaviour_learning_rate", "max_grad_norm", "target_rate")
        _within(self, lambda_=(0.0, 1.0), target_rate=(0.0, 1.0))
        if self.discount is not None and not 0.0 < self.discount <= 1.0:
            raise ValueError(f"discount must lie in (0, 1], got {self.discount}")


@dataclass(frozen=True)
class CollectionConfig:
    """How experience is gathered, and how much is learned from it.

    Attributes:
        behaviour: Who acts while collecting: `planner`, `actor`, or `both` in alternate episodes.
        noise_std: Standard deviation of the noise added to the planner's action.
        prefill_decisions: Random decisions before learning starts.
        round_decisions: Decisions per epoch: this many are collected, then learned from.
        updates_per_decision: Updates per collected decision (the replay ratio, in updates).
        overlap: Whether the next round is collected in another process while this one is learned from.
    """

    behaviour: str = "planner"
    noise_std: float = 0.2
    prefill_decisions: int = 1000
    round_decisions: int = 250
    updates_per_decision: float = 0.5
    overlap: bool = True

    def __post_init__(self) -> None:
        _one_of(self, behaviour=BEHAVIOURS)
        _at_least(self, noise_std=0.0, prefill_decisions=1, round_decisions=1)
        _above_zero(self, "updates_per_decision")


@dataclass(frozen=True)
class ReplayConfig:
    """Where experience is kept.

    Attributes:
        capacity: Decisions kept; None holds the whole run when its length is known, else 500,000.
        on_device: Whether the frames live on the training device instead of in main memory.
    """

    capacity: int | None = None
    on_device: bool = False

    def __post_init__(self) -> None:
        if self.capacity is not None and self.capacity < 1:
            raise ValueError(f"capacity must be at least 1, got {self.capacity}")


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
        _at_least(self, every_frames=1, episodes=1, final_episodes=1)


@dataclass(frozen=True)
class RunConfig:
    """One training run.

    Attributes:
        frames: Simulator frames to train for (counted before action repeat); None leaves it to `minutes`.
        minutes: Minutes of wall clock to train for; None leaves it to `frames`.
        seed: Seed of every random stream of the run.
        device: `auto`, `cpu` or `cuda`.
        threads: CPU threads for learning; None leaves it to torch.
        run_dir: Folder of the run; None makes `runs/<domain>-<task>-<date>`.
    """

    frames: int | None = None
    minutes: float | None = None
    seed: int = 0
    device: str = "auto"
    threads: int | None = None
    run_dir: str | None = None

    def __post_init__(self) -> None:
        _one_of(self, device=DEVICES)
        _at_least(self, seed=0)
        for name in ("frames", "minutes", "threads"):
            value = getattr(self, name)
            if value is not None and value <= 0:
                raise ValueError(f"{name} must be positive, got {value}")


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


def derive_seed(seed: int, name: str, counter: int = 0) -> int:
    """A seed in [0, 2**31) for the stream `name` of a run, the same on every machine."""
    digest = hashlib.sha256(f"{seed}/{name}/{counter}".encode()).digest()
    return int.from_bytes(digest[:4], "little") >> 1


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


def _at_least(config: Any, **bounds: float) -> None:
    for name, bound in bounds.items():
        if not getattr(config, name) >= bound:
            raise ValueError(f"{name} must be at least {bound}, got {getattr(config, name)}")


def _above_zero(config: Any, *names: str) -> None:
    for name in names:
        if not getattr(config, name) > 0.0:
            raise ValueError(f"{name} must be above 0, got {getattr(config, name)}")


def _within(config: Any, **bounds: tuple[float, float]) -> None:
    for name, (low, high) in bounds.items():
        if not low <= getattr(config, name) <= high:
            raise ValueError(f"{name} must lie in [{low}, {high}], got {getattr(config, name)}")


def _one_of(config: Any, **choices: tuple[str, ...]) -> None:
    for name, allowed in choices.items():
        if getattr(config, name) not in allowed:
            raise ValueError(f"{name} must be one of {', '.join(allowed)}, got {getattr(config, name)!r}")
