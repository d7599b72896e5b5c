"""Loads recorded episodes into the replay of a new run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from latentplan.config import Config, UserError
from latentplan.config.suites import DEFAULT_SUITE
from latentplan.envs.vector import make_guarded_env
from latentplan.training.demonstrations.fitting import FittedRecording, fit_all, make_target
from latentplan.training.demonstrations.opening import open_recordings

if TYPE_CHECKING:
    from latentplan.replay.buffer import Replay
    from latentplan.training.collection.collector import EnvFactory


def read_demonstrations(config: Config, make_user_env: EnvFactory | None) -> list[FittedRecording]:
    """The recordings that the settings name, after a check that they fit the run's environment.

    The environment is made once, to ask for its spaces, and closed again.

    Args:
        config: Settings of the run.
        make_user_env: Makes the user's own environment; None makes the environment of the settings.

    Raises:
        UserError: A recording cannot be read, or does not fit.
    """
    recordings = open_recordings(config.replay.demonstrations)
    if not recordings:
        return []
    is_foreign = make_user_env is not None or config.env.suite != DEFAULT_SUITE
    env = make_guarded_env(
        config.env,
        None,
        make_user_env,
        isolate=config.collection.overlap and is_foreign,
        step_timeout_s=config.collection.step_timeout_s,
    )
    try:
        target = make_target(config.env, env.facts, config.model.deter_dim)
    finally:
        env.close()
    return fit_all(recordings, target, config.learning.sequence_length)


def count_rows(recordings: Sequence[FittedRecording], sequence_length: int, rank: int = 0, size: int = 1) -> int:
    """Rows of the episodes that one of several learning processes gets: one for each frame.

    Args:
        recordings: The recordings.
        sequence_length: Decisions of a training sequence, which every process has to find in an episode of its own.
        rank: Number of the process.
        size: Number of processes.

    Raises:
        UserError: There are fewer episodes of that length than processes.
    """
    lengths = [length for recording in recordings for length in recording.lengths]
    num_long = sum(length >= sequence_length for length in lengths)
    if recordings and num_long < size:
        raise UserError(
            f"replay.demonstrations hold {num_long} episodes of at least learning.sequence_length ({sequence_length}) "
            f"decisions, fewer than the {size} processes of run.devices x run.nodes, of which each gets its own"
        )
    return sum(recording.lengths[index] + 1 for recording, index in _deal(recordings, rank, size))


def seed_replay(replay: Replay, recordings: Sequence[FittedRecording], rank: int = 0, size: int = 1) -> None:
    """Adds all episodes to the replay's lane of recorded rows, in order; of several processes, each gets its share.

    Raises:
        UserError: An episode is damaged.
    """
    for recording, index in _deal(recordings, rank, size):
        replay.add(replay.num_lanes - 1, recording.read(index))


def _deal(recordings: Sequence[FittedRecording], rank: int, size: int) -> list[tuple[FittedRecording, int]]:
    """The episodes of one process, in order: every size-th from the longest on, so that each process gets long ones."""
    episodes = [
        (recording, index) for recording in recordings for index, length in enumerate(recording.lengths) if length > 0
    ]
    by_length = sorted(range(len(episodes)), key=lambda place: -episodes[place][0].lengths[episodes[place][1]])
    return [episodes[place] for place in sorted(by_length[rank::size])]
