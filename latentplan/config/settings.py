"""The settings of a run, one frozen dataclass per component, and their plain form.

Defaults are the recommended values. Bad values raise `ValueError` naming the field.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from latentplan.config.checks import MAX_THREADS, UserError, above_zero, at_least, one_of, within
from latentplan.config.learning import CollectionConfig, LearningConfig
from latentplan.config.planner import PlannerConfig
from latentplan.config.removed import drop_removed

LATENT_DIM = 32
RenderQuality = Literal["exact", "fast", "fastest"]
Floor = Literal["suite", "endless"]
Device = Literal["auto", "cpu", "cuda"]
RENDER_QUALITIES = get_args(RenderQuality)
FLOORS = get_args(Floor)
DEVICES = get_args(Device)
USER_DOMAIN = "user"  # the domain of runs in an environment of the user's own


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
        floor: `suite` ends the picture of the floor where the suite does, two metres behind a walker's start; `endless`
            draws it there as well, for goals that lead backwards. Physics and the picture ahead are the same.
        num_envs: Environments that collect at once; more than one runs each in its own process.
        objective: Expression over the body's quantities that pays in place of the task's reward, once per control step,
            such as `speed -> 2.0 and height > 1.1`; None leaves the task's.
    """

    domain: str = "walker"
    task: str | None = None
    action_repeat: int = 2
    camera: int = 0
    render_quality: RenderQuality = "fast"
    floor: Floor = "suite"
    num_envs: int = 1
    objective: str | None = None

    def __post_init__(self) -> None:
        at_least(self, action_repeat=1, num_envs=1, camera=-1)
        one_of(self, render_quality=RENDER_QUALITIES, floor=FLOORS)


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
        turns: Turns of each frame by a quarter that agents keep a belief of, and act by the mean of: 1, or 4 for a body
            to which every side is the same.
    """

    latent_dim: int = LATENT_DIM
    deter_dim: int = 192
    hidden_dim: int = 192
    encoder_channels: tuple[int, ...] = (32, 48, 64)
    decoder_channels: int = 16
    num_bins: int = 63
    turns: int = 1

    def __post_init__(self) -> None:
        if self.turns not in (1, 4):
            raise ValueError(f"turns must be 1 or 4, got {self.turns}")
        at_least(self, latent_dim=1, deter_dim=1, hidden_dim=1, decoder_channels=1, num_bins=3)
        if not 1 <= len(self.encoder_channels) <= 5 or min(self.encoder_channels) < 1:
            raise ValueError(f"encoder_channels must hold 1 to 5 positive sizes, got {self.encoder_channels}")


@dataclass(frozen=True)
class ReplayConfig:
    """Where experience is kept.

    Attributes:
        capacity: Decisions kept; None holds the whole run when its length is known, else 200,000; and, when one is
            resumed, no fewer than it has.
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
        threads: CPU threads of each half of an update (model and behaviour learn side by side), in [1, 1024]; None
            shares every core but the one that collects between the two.
        run_dir: Folder of the run; None makes `runs/<domain>-<task>-<date>`.
    """

    frames: int | None = None
    minutes: float | None = None
    seed: int = 0
    device: Device = "auto"
    threads: int | None = None
    run_dir: str | None = None

    def __post_init__(self) -> None:
        one_of(self, device=DEVICES)
        at_least(self, seed=0)
        above_zero(self, "frames", "minutes")
        if self.threads is not None:
            within(self, threads=(1, MAX_THREADS))


@dataclass(frozen=True)
class Config:
    """Everything that defines a run.

    Raises:
        UserError: Episodes cut while collecting would be too short, a CUDA graph could not reach the replay, or agents
            would see turned frames that nothing has learned from.
    """

    env: EnvConfig = field(default_factory=EnvConfig)
    model: ModelConfig = field(default_factory=ModelConfig)
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    learning: LearningConfig = field(default_factory=LearningConfig)
    collection: CollectionConfig = field(default_factory=CollectionConfig)
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    run: RunConfig = field(default_factory=RunConfig)

    def __post_init__(self) -> None:
        cut, length = self.collection.episode_decisions, self.learning.sequence_length
        if cut is not None and cut < length:
            raise UserError(f"collection.episode_decisions ({cut}) must be at least {length}, learning.sequence_length")
        if self.model.turns > 1 and self.learning.turned_share == 0.0:
            raise UserError("model.turns 4 needs learning.turned_share above 0: turned frames have to be learned from")
        if self.learning.cuda_graph and not self.replay.on_device:
            why = "a graph gathers its sequences itself; give both, or neither"
            raise UserError(f"learning.cuda_graph needs replay.on_device: {why}")


def to_dict(config: Any) -> dict[str, Any]:
    """The settings as plain nested dictionaries, tuples as lists (for YAML and JSON)."""
    return {
        name: to_dict(value) if dataclasses.is_dataclass(value) else list(value) if isinstance(value, tuple) else value
        for name, value in ((f.name, getattr(config, f.name)) for f in dataclasses.fields(config))
    }


def from_dict(values: dict[str, Any]) -> Config:
    """The inverse of `to_dict`; absent fields take their defaults, and settings that no longer exist are dropped.

    Raises:
        ValueError: A section or field is unknown, a value is not allowed, or a setting that no longer exists has a
            value other than the one that had no effect.
    """
    sections = {f.name: f.default_factory for f in dataclasses.fields(Config)}
    built = {}
    for section, settings in values.items():
        if section not in sections:
            raise ValueError(f"unknown section {section!r}; available: {', '.join(sections)}")
        kind: Any = sections[section]
        names = {f.name for f in dataclasses.fields(kind)}
        settings = drop_removed(section, settings)
        for name in settings:
            if name not in names:
                raise ValueError(f"unknown setting {section}.{name}; available: {', '.join(sorted(names))}")
        built[section] = kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in settings.items()})
    return Config(**built)
