"""Makes rows of replay from recorded episodes, after a check that they fit the environment of a run."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from latentplan.config import USER_DOMAIN, EnvConfig, EnvironmentFault, UserError
from latentplan.config.spaces import Spaces
from latentplan.envs.spaces import ONLY_PICTURE, Actions, Interface, Observations, is_picture
from latentplan.replay.buffer import Rows
from latentplan.training.demonstrations.recording import RecordedEpisode, Recording

EXCESS = 0.01  # of a number's range, by which recorded actions may exceed it


@dataclass(frozen=True)
class Target:
    """What recorded episodes have to fit.

    Attributes:
        env: Settings of the run's environment.
        interface: What the environment shows and takes.
        labels: Quantities that the environment reports with each frame.
        deter_dim: Size of a stored belief.
    """

    env: EnvConfig
    interface: Interface
    labels: tuple[str, ...]
    deter_dim: int


class FittedRecording:
    """A recording whose episodes become rows of a run's replay.

    Args:
        recording: The recording.
        target: What it has to fit.

    Raises:
        UserError: The recording does not fit; one line says what differs and, where there is one, the remedy.
    """

    def __init__(self, recording: Recording, target: Target) -> None:
        self.recording, self.target = recording, target
        self.lengths = recording.lengths
        self._check_steps()
        pictures, vectors = self._match_pictures(), self._match_vectors()
        self._observations = Observations(recording.space, target.env.frame_size, pictures, vectors)
        self._actions = Actions(target.interface.action_space)
        self._check_actions()
        self._check_quantities()

    @property
    def num_rows(self) -> int:
        """Rows of all episodes: one for each frame."""
        return sum(length + 1 for length in self.lengths if length > 0)

    def read(self, index: int) -> Rows:
        """The rows of an episode, with empty beliefs.

        Raises:
            UserError: The episode is damaged, or holds values that an environment may not give.
        """
        episode = self.recording.read(index)
        count = len(episode.rewards) + 1
        with np.errstate(over="ignore"):
            rewards = np.append(episode.rewards, 0.0).astype(np.float32)
        if not (np.isfinite(rewards).all() and np.isfinite(episode.actions).all()):
            raise UserError(f"{self.recording.path}: actions and rewards of episode {index} must be finite")
        self._check_range(episode.actions, index)
        actions = np.zeros((count, self._actions.dim), np.float32)
        actions[:-1] = self._actions.from_own(episode.actions)
        continues = np.ones(count, np.float32)
        continues[-2] = 0.0 if episode.is_terminal else 1.0
        frames, labels = self._read_observations(episode, index)
        return Rows(
            frames=frames,
            deter=np.zeros((count, self.target.deter_dim), np.float32),
            actions=actions,
            rewards=rewards,
            continues=continues,
            is_first=np.arange(count) == 0,
            labels=labels,
        )

    def _read_observations(self, episode: RecordedEpisode, index: int) -> tuple[np.ndarray, np.ndarray]:
        """The frames of an episode, and its labels: quantities and then vectors, float32 (time, label)."""
        times = range(len(episode.rewards) + 1)
        moments = [{name: values[time] for name, values in episode.observations.items()} for time in times]
        try:
            frames = np.stack([self._observations.read(moment)[0] for moment in moments])
            labels = np.zeros((len(moments), 0), np.float32)
            if self.target.labels:
                assert episode.quantities is not None
                labels = np.asarray(episode.quantities, np.float32)
                if labels.shape != (len(moments), len(self.target.labels)) or not np.isfinite(labels).all():
                    raise UserError(
                        f"{self.recording.path}: quantities of episode {index} must be finite, "
                        f"{len(self.target.labels)} numbers for each of {len(moments)} frames"
                    )
            if self.target.interface.vectors:
                vectors = np.stack([self._observations.read_vectors(moment) for moment in moments])
                labels = np.concatenate([labels, vectors], axis=1)
        except EnvironmentFault as fault:
            reason = str(fault).replace("the environment must return", "it must hold")
            raise UserError(f"{self.recording.path}, episode {index}: {reason}") from None
        return frames, labels

    def _check_steps(self) -> None:
        recorded, own = self.recording.action_repeat, self.target.env.action_repeat
        if recorded != own:
            raise UserError(
                f"{self.recording.path} has one action for every {_count(recorded, 'step')} of its environment, and "
                f"this run one for {own}: give --env.action_repeat {recorded}"
            )

    def _match_pictures(self) -> list[str]:
        """The pictures of the recording that stand for those of the environment, in its order."""
        wanted, vectors = self.target.interface.pictures, dict(self.target.interface.vectors)
        parts = self.recording.space.spaces.items()
        has = [name for name, part in parts if is_picture(part) and name not in vectors]
        if set(wanted) <= set(has):
            return list(wanted)
        if len(has) == len(wanted) == 1 and (not self.recording.is_own or ONLY_PICTURE in (*has, *wanted)):
            return has  # names of other programs need not be those of the environment
        raise UserError(
            f"{self.recording.path} shows {', '.join(has)}, and the environment {', '.join(wanted)}: choose pictures "
            "that both have, with --env.camera or --env.cameras"
        )

    def _match_vectors(self) -> list[str]:
        """The vectors of the recording that stand for those of the environment, in its order."""
        wanted = dict(self.target.interface.vectors)
        parts = self.recording.space.spaces.items()
        has = {name: int(np.prod(part.shape or ())) for name, part in parts if name in wanted or not is_picture(part)}
        if all(has.get(name) == size for name, size in wanted.items()):
            return list(wanted)
        if not self.recording.is_own and len(has) == 1 and list(has.values()) == list(wanted.values()):
            return list(has)
        raise UserError(
            f"{self.recording.path} has the vectors {_describe_sizes(has)}, and env.vectors names "
            f"{_describe_sizes(wanted)}: name vectors that both have"
        )

    def _check_actions(self) -> None:
        own, recorded = self._actions.bounds, self.recording.bounds
        if self.recording.num_numbers != own.shape[1]:
            raise UserError(
                f"{self.recording.path} has actions of {_count(self.recording.num_numbers, 'number')}, and the "
                f"environment takes {own.shape[1]}: it was recorded in another environment"
            )
        if recorded is not None and not np.allclose(recorded, own, rtol=1e-5, atol=1e-6):
            raise UserError(
                f"{self.recording.path} has actions {_describe_bounds(recorded)}, and the environment takes "
                f"{_describe_bounds(own)}: it was recorded in another environment, or in other units"
            )

    def _check_range(self, actions: np.ndarray, index: int) -> None:
        """Refuses actions outside of the environment's range, where the recording does not tell its own range."""
        low, high, _ = self._actions.bounds
        room = EXCESS * (high - low)
        if self.recording.bounds is None and len(actions):
            outside = (actions < low - room) | (actions > high + room)
            if outside.any():
                raise UserError(
                    f"{self.recording.path}: an action of episode {index} is {actions[outside][0]:g}, and the "
                    f"environment takes {_describe_bounds(self._actions.bounds)}: the units differ"
                )

    def _check_quantities(self) -> None:
        wanted = self.target.labels
        if wanted and self.recording.quantities != wanted:
            raise UserError(
                f"{self.recording.path} lacks the quantities that {self.target.env.domain} reports with each frame "
                f"({', '.join(wanted[:3])}, ...): record it in this domain with collection.keep_episodes"
            )


def fit_all(recordings: Sequence[Recording], target: Target, sequence_length: int) -> list[FittedRecording]:
    """The recordings, if all of them fit an environment and one episode is long enough to learn from.

    A warning names the recordings of other tasks, whose rewards are those of the other task.

    Args:
        recordings: The recordings.
        target: What they have to fit.
        sequence_length: Decisions of a training sequence.

    Raises:
        UserError: A recording does not fit, or all episodes are too short.
    """
    fitted = [FittedRecording(recording, target) for recording in recordings]
    longest = max((length for recording in recordings for length in recording.lengths), default=0)
    if longest < sequence_length:
        raise UserError(
            f"no recorded episode has learning.sequence_length ({sequence_length}) decisions, the longest has "
            f"{longest}: lower --learning.sequence_length"
        )
    own = f"{target.env.suite}-{target.env.domain}-{target.env.task}"
    if target.env.objective is not None:
        own += f" with the objective {target.env.objective!r}"
    others = [each for each in recordings if each.is_own and not _is_same_task(each.origin, own)]
    if others:
        warnings.warn(
            f"{others[0].path} was recorded in {others[0].origin}, and this run learns {own}: its rewards are those of "
            f"{others[0].origin} ({len(others)} of {len(recordings)} recordings)",
            RuntimeWarning,
            stacklevel=2,
        )
    return fitted


def _is_same_task(origin: str, own: str) -> bool:
    """Whether rewards are those of the same task, or of a user's environment that was wrapped without a name."""
    by_user = f"{EnvConfig.suite}-{USER_DOMAIN}-"
    return origin == own or (origin == f"{by_user}{None}" and own.startswith(by_user))


def make_target(env: EnvConfig, facts: Mapping[str, object], deter_dim: int) -> Target:
    """What recorded episodes have to fit in an environment.

    Args:
        env: Settings of the environment.
        facts: Its attributes, see `latentplan.envs.process.Lane.facts`.
        deter_dim: Size of a stored belief.
    """
    labels = facts["labels"] or {}
    assert isinstance(labels, Mapping)
    return Target(env, read_interface(facts), tuple(labels), deter_dim)


def read_interface(facts: Mapping[str, object]) -> Interface:
    """What an environment shows and takes; one that does not tell it shows frames and takes numbers in [-1, 1].

    Raises:
        UserError: The environment does not tell it, and shows several pictures or vectors.
    """
    interface, spaces = facts["interface"], facts["spaces"] or Spaces()
    if isinstance(interface, Interface):
        return interface
    assert isinstance(spaces, Spaces)
    if spaces.cameras > 1 or spaces.vector_dim:
        raise UserError(
            "recorded episodes need names of the environment's pictures and vectors: give it an attribute `interface`, "
            "see latentplan.envs.registry"
        )
    return Interface((ONLY_PICTURE,), (), facts["action_space"])  # type: ignore[arg-type]


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _describe_sizes(sizes: Mapping[str, int]) -> str:
    return ", ".join(f"{name} ({size})" for name, size in sizes.items()) or "none"


def _describe_bounds(bounds: np.ndarray) -> str:
    """The range of actions in a few words."""
    low, high, categories = bounds
    ranges = [
        f"{int(count)} choices from {start:g}" if count else f"{start:g} to {end:g}"
        for start, end, count in zip(low, high, categories, strict=True)
    ]
    distinct = list(dict.fromkeys(ranges))
    return f"of {_count(len(ranges), 'number')}, {', '.join(distinct[:3])}{', ...' if len(distinct) > 3 else ''}"
