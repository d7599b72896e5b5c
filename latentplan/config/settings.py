"""The settings of a run: one frozen dataclass per component, and their plain form for YAML and JSON.

Defaults are the recommended values. A value that is not allowed raises a `ValueError` that names the field.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from latentplan.config.checks import (
    MAX_EPISODES,
    MAX_THREADS,
    UserError,
    above_zero,
    at_least,
    no_text,
    one_of,
    shown,
    within,
)
from latentplan.config.earlier import as_saved, drop_removed
from latentplan.config.learning import CollectionConfig, LearningConfig
from latentplan.config.parsing import Setting, list_settings, option, take_values
from latentplan.config.planner import PlannerConfig
from latentplan.config.reading import read_kwargs
from latentplan.config.spaces import FRAME_SIZES, MOST_CAMERAS, check_frame_size

LATENT_DIM = 32
RenderQuality = Literal["exact", "fast", "fastest"]
Floor = Literal["suite", "endless"]
Device = Literal["auto", "cpu", "cuda"]
Pixels = Literal["observation", "render"]
Strategy = Literal["ddp"]
RENDER_QUALITIES = get_args(RenderQuality)
FLOORS = get_args(Floor)
DEVICES = get_args(Device)
PIXELS = get_args(Pixels)
STRATEGIES = get_args(Strategy)
LOGGERS = ("tensorboard", "csv", "wandb", "trackio", "mlflow")
MAX_REPEAT = 10_000  # ten of the longest episodes of dm_control
MAX_ENVS = 1024
MAX_CAMERA = 1000
MAX_DECODER_LAYERS = 64
MAX_RANKS = 1024  # learning processes of a node, and nodes
USER_DOMAIN = "user"  # `EnvConfig.domain` of runs in an environment that the user wrote


@dataclass(frozen=True)
class EnvConfig:
    """The environment: the body, its task and its camera.

    Attributes:
        domain: Domain of the suite.
        task: Task of the domain; None takes the usual task of the domain.
        action_repeat: Simulator control steps per decision.
        camera: Camera id of the MuJoCo model.
        cameras: Several cameras, whose pictures the agent sees together: ids of the MuJoCo model, or image keys of a
            `Dict` observation of your own environment. Empty takes `camera`, or all images of the `Dict` that `vectors`
            does not name.
        frame_size: Side of the pictures in pixels: 64, 84, 96 or 128.
        vectors: What the agent sees beside the pictures: keys of vectors in a `Dict` observation of your own
            environment; in `dm_control` keys of the task's observation, or `proprioception` for all of them.
        render_quality: `exact` is dm_control's default; `fast` has a small shadow map; `fastest` has no shadows,
            reflections or anti-aliasing, which makes learning easier.
        render_slices: Flat sides around a round shape in the agent's pictures, in [4, 64]; quality `exact` always draws
            28, and agents of earlier versions have 28. Fewer sides are drawn faster.
        floor: `suite` draws the floor as the suite does, which ends two metres behind a walker's start; `endless` draws
            the floor there as well, for goals that lead backwards. Physics and the picture ahead are the same.
        num_envs: Environments that collect at the same time; if there are several, each runs in its own process.
        objective: Expression over the body's quantities that replaces the task's reward at every control step, such as
            `speed -> 2.0 and height > 1.1`; None keeps the task's reward.
        suite: Suite of the domain, a name in `latentplan/config/suites.py`.
        kwargs: Arguments of an environment of gymnasium's registry (suite `gymnasium`), as a JSON object; the argument
            `max_episode_steps` sets its time limit.
        pixels: Where the pictures of an environment outside of dm_control come from: `observation` takes its
            observations, `render` takes what its `render()` draws, squeezed to a square; of the observations the agent
            then sees what `vectors` names, and nothing else.
    """

    domain: str = "walker"
    task: str | None = None
    action_repeat: int = 2
    camera: int = 0
    render_quality: RenderQuality = "fast"
    render_slices: int = 14
    floor: Floor = "suite"
    num_envs: int = 1
    objective: str | None = None
    suite: str = "dm_control"
    kwargs: str = option("{}", metavar="JSON")
    pixels: Pixels = "observation"
    cameras: tuple[str, ...] = option((), separator=",")
    frame_size: int = FRAME_SIZES[0]
    vectors: tuple[str, ...] = option((), separator=",")

    def __post_init__(self) -> None:
        no_text(self, "cameras", "vectors")
        read_kwargs(self.kwargs)
        check_frame_size(self.frame_size)
        if len(set(self.vectors)) != len(self.vectors):
            raise ValueError(f"vectors must be different keys, got {' '.join(self.vectors)}")
        if len(set(self.cameras)) != len(self.cameras) or len(self.cameras) > MOST_CAMERAS:
            raise ValueError(f"cameras must be at most {MOST_CAMERAS} different ones, got {' '.join(self.cameras)}")
        within(self, action_repeat=(1, MAX_REPEAT), num_envs=(1, MAX_ENVS), camera=(-1, MAX_CAMERA))
        within(self, render_slices=(4, 64))
        one_of(self, render_quality=RENDER_QUALITIES, floor=FLOORS, pixels=PIXELS)


@dataclass(frozen=True)
class ModelConfig:
    """Sizes of the world model and its heads.

    Attributes:
        latent_dim: Size of the stochastic latent, the space in which the planner searches.
        deter_dim: Size of the GRU state.
        hidden_dim: Width of the hidden layers of every head.
        encoder_channels: Channels of the encoder's layers; the first layer reads patches of 4 x 4 pixels, each later
            layer halves the grid.
        decoder_channels: Channels of the decoder's 8 x 8 grid of tokens.
        decoder_layers: Hidden layers that the tokens read beside the features, at most 64; agents of earlier versions
            have none.
        decoder_width: Width of these layers. With 88 an agent for a body of 6 actions takes 2.5 MB.
        num_bins: Bins of the distributional reward and value heads.
        turns: Quarter turns of each frame for which an agent keeps a belief, and over which its action is averaged: 1,
            or 4 for a body that looks the same from every side.
    """

    latent_dim: int = LATENT_DIM
    deter_dim: int = 192
    hidden_dim: int = 192
    encoder_channels: tuple[int, ...] = (32, 48, 64)
    decoder_channels: int = 12
    decoder_layers: int = 2
    decoder_width: int = 88
    num_bins: int = 63
    turns: int = 1

    def __post_init__(self) -> None:
        if self.turns not in (1, 4):
            raise ValueError(f"turns must be 1 or 4, got {self.turns}")
        at_least(self, latent_dim=1, deter_dim=1, hidden_dim=1, num_bins=3)
        at_least(self, decoder_channels=1, decoder_width=1)
        within(self, decoder_layers=(0, MAX_DECODER_LAYERS))
        if not 1 <= len(self.encoder_channels) <= 5 or min(self.encoder_channels) < 1:
            raise ValueError(f"encoder_channels must hold 1 to 5 positive sizes, got {self.encoder_channels}")


@dataclass(frozen=True)
class ReplayConfig:
    """The replay buffer.

    Attributes:
        capacity: Collected decisions kept; None keeps the whole run where its length in frames is known and its
            episodes have 20 decisions or more on average (where they are shorter, the oldest decisions are dropped),
            else 200,000 decisions, and never fewer than a resumed run already holds.
        on_device: Whether frames are stored on the training device instead of in main memory.
        demonstrations: Recorded episodes that a new run starts with: files and folders of `collection.keep_episodes`,
            folders of Minari datasets and of LeRobot datasets (v3). They stay in replay for the whole run, beside
            `capacity`.
    """

    capacity: int | None = None
    on_device: bool = False
    demonstrations: tuple[str, ...] = option((), separator=",", metavar="FILE")

    def __post_init__(self) -> None:
        no_text(self, "demonstrations")
        above_zero(self, "capacity")


@dataclass(frozen=True)
class EvaluationConfig:
    """Evaluations during and after training.

    Attributes:
        every_frames: Simulator frames between evaluations.
        episodes: Episodes of the planner, and of the actor from the same starts, per evaluation during training.
        final_episodes: Episodes of the evaluation at the end of a run.
        video: Whether each evaluation films its first episode.
        report: Whether a run writes `report.html` into its folder after the final evaluation.
    """

    every_frames: int = 10_000
    episodes: int = 2
    final_episodes: int = 10
    video: bool = True
    report: bool = True

    def __post_init__(self) -> None:
        at_least(self, every_frames=1)
        within(self, episodes=(1, MAX_EPISODES), final_episodes=(1, MAX_EPISODES))


@dataclass(frozen=True)
class RunConfig:
    """Length, seed, device and folder of a training run.

    Attributes:
        frames: Simulator frames to train for, counted before action repeat; None sets no limit.
        minutes: Minutes of wall clock to train for; None sets no limit. A run ends at the first limit that it reaches.
        updates: Updates to train for; None sets no limit.
        seed: Seed of every random stream of the run.
        device: Device to learn on; `auto` takes CUDA where it is usable.
        threads: CPU threads for each half of an update (model and behaviour learn in parallel), in [1, 1024]; None
            leaves one core to each collection process that works beside the updates, and divides the others between
            the halves of all learning processes of the machine.
        run_dir: Folder of the run; None makes `runs/<domain>-<task>-seed<seed>-<date>`.
        logger: Trackers that get scalars and films: tensorboard, csv, wandb, trackio, mlflow.
        devices: Learning processes of a node: one for each GPU or, on a CPU, as many as you like. They share each
            batch, and each collects into a replay of its own. Frames and decisions count those of all together.
        nodes: Machines that learn together, each with `devices` processes; the folder of the run must be one that all
            of them see. Each machine starts the same command, with MASTER_ADDR, MASTER_PORT and NODE_RANK set, or by
            torchrun.
        strategy: How several processes learn together: `ddp` averages their gradients.
        ray_address: Address of the Ray cluster of `collection.backend ray`, as HOST:PORT; the learner runs on one of
            its machines. None starts Ray on this machine alone.
    """

    frames: int | None = None
    minutes: float | None = None
    seed: int = 0
    device: Device = "auto"
    threads: int | None = None
    run_dir: str | None = None
    updates: int | None = None
    logger: tuple[str, ...] = option(("tensorboard",), separator=",")
    devices: int = 1
    nodes: int = 1
    strategy: Strategy = "ddp"
    ray_address: str | None = option(None, metavar="HOST:PORT")

    def __post_init__(self) -> None:
        one_of(self, device=DEVICES, strategy=STRATEGIES)
        within(self, devices=(1, MAX_RANKS), nodes=(1, MAX_RANKS))
        no_text(self, "logger")
        for name in self.logger:
            if name not in LOGGERS:
                raise ValueError(f"logger must be of {', '.join(LOGGERS)}, got {shown(name)}")
        at_least(self, seed=0)
        above_zero(self, "frames", "minutes", "updates")
        if self.threads is not None:
            within(self, threads=(1, MAX_THREADS))

    @property
    def num_ranks(self) -> int:
        """Learning processes of all nodes."""
        return self.devices * self.nodes


@dataclass(frozen=True)
class Config:
    """Every setting of a run.

    Raises:
        UserError: Two settings contradict each other: collected episodes shorter than training sequences, a CUDA graph
            without a replay on the device or with several processes, a batch that the processes cannot share evenly,
            agents that see turned frames without learning from turned frames, no collection without demonstrations, or
            settings of several collection processes where there is none.
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
            raise UserError(
                "model.turns 4 needs learning.turned_share above 0, so that the model learns from turned frames"
            )
        if self.learning.cuda_graph and not self.replay.on_device:
            why = "a graph reads its sequences from the device; set both, or neither"
            raise UserError(f"learning.cuda_graph needs replay.on_device: {why}")
        if self.run.num_ranks > 1:
            self._check_ranks()
        if not self.collection.enabled:
            self._check_offline()
        self._check_workers()

    @property
    def num_lanes(self) -> int:
        """Environments that collect for one learning process, over all its workers."""
        return self.env.num_envs * self.collection.workers

    @property
    def local_collectors(self) -> int:
        """Collection processes beside each learning process on its machine; those of a Ray cluster are elsewhere."""
        if not self.collection.overlap:
            return 0
        return self.collection.workers if self.run.ray_address is None else 1

    def _check_workers(self) -> None:
        """Refuses settings of collection processes that have no effect."""
        collection = self.collection
        if not collection.overlap and (collection.workers > 1 or collection.backend == "ray"):
            raise UserError(
                "collection.overlap false collects in the learning process: leave out collection.workers and "
                "collection.backend, or set collection.overlap true"
            )
        if collection.asynchronous and collection.workers == 1:
            raise UserError("collection.asynchronous has no effect with one worker: give --collection.workers too")
        if self.run.ray_address is not None and collection.backend != "ray":
            raise UserError("run.ray_address has no effect here: give --collection.backend ray too")

    def _check_ranks(self) -> None:
        """Refuses settings that several learning processes cannot share."""
        ranks, learning = self.run.num_ranks, self.learning
        for name in ("batch_size", "imagination_starts"):
            if (count := getattr(learning, name)) % ranks:
                raise UserError(
                    f"learning.{name} ({count}) must be a multiple of {ranks}, the processes of run.devices "
                    f"({self.run.devices}) x run.nodes ({self.run.nodes}), which share it evenly"
                )
        if learning.cuda_graph:
            raise UserError(
                f"learning.cuda_graph records the update of one process, and run.devices ({self.run.devices}) x "
                f"run.nodes ({self.run.nodes}) are {ranks}: set learning.cuda_graph false"
            )

    def _check_offline(self) -> None:
        """Refuses settings that have no effect, or are missing, in a run that collects nothing."""
        if not self.replay.demonstrations:
            raise UserError(
                "collection.enabled false needs something else to learn from: name recorded episodes with "
                "--replay.demonstrations"
            )
        if self.run.frames is not None:
            raise UserError(
                "run.frames counts collected frames, and collection.enabled false collects none: give --updates or "
                "--minutes"
            )
        if self.collection.keep_episodes is not None:
            raise UserError("collection.keep_episodes has no effect where collection.enabled is false: leave it out")


def to_dict(config: Any) -> dict[str, Any]:
    """The settings as plain nested dictionaries, tuples as lists (for YAML and JSON)."""
    return {
        name: to_dict(value) if dataclasses.is_dataclass(value) else list(value) if isinstance(value, tuple) else value
        for name, value in ((f.name, getattr(config, f.name)) for f in dataclasses.fields(config))
    }


def by_key(sections: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The settings of all sections by `section.name`."""
    return {f"{section}.{name}": value for section, fields in sections.items() for name, value in fields.items()}


def from_dict(values: dict[str, Any]) -> Config:
    """The inverse of `to_dict`, which may have been called by an earlier version.

    Absent fields take their defaults, or what earlier versions did; settings that no longer exist are dropped.

    Raises:
        ValueError: A section or field is unknown, a value has the wrong type or is not allowed, or a setting that no
            longer exists has a value other than the one that had no effect.
    """
    sections = {f.name: f.default_factory for f in dataclasses.fields(Config)}
    built = {}
    for section, settings in values.items():
        if section not in sections:
            raise ValueError(f"unknown section {section!r}; available: {', '.join(sections)}")
        kind: Any = sections[section]
        names = {f.name for f in dataclasses.fields(kind)}
        settings = as_saved(section, drop_removed(section, settings))
        for name in settings:
            if name not in names:
                raise ValueError(f"unknown setting {section}.{name}; available: {', '.join(sorted(names))}")
        values = take_values(
            _settings_of(kind, section), {f"{section}.{name}": value for name, value in settings.items()}
        )
        built[section] = kind(**{key.removeprefix(f"{section}."): value for key, value in values.items()})
    return Config(**built)


@functools.cache
def _settings_of(kind: type, section: str) -> list[Setting]:
    return list_settings(kind, f"{section}.")
