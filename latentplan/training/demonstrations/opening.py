"""Finds out what wrote a recording, and opens it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from latentplan.config import UserError
from latentplan.training.demonstrations.episode_file import EpisodeFile, list_episode_files
from latentplan.training.demonstrations.lerobot_dataset import INFO, LeRobotDataset
from latentplan.training.demonstrations.minari_dataset import MinariDataset, find_minari
from latentplan.training.demonstrations.recording import Recording

FLAG = "--replay.demonstrations"


def open_recordings(names: Iterable[str]) -> list[Recording]:
    """Opens files and folders; of a folder of episode files every file.

    Args:
        names: The files and folders.

    Raises:
        UserError: One of them does not exist, is no recording, or is damaged.
    """
    return [recording for name in names for recording in _open(Path(name))]


def _open(path: Path) -> list[Recording]:
    try:
        exists = path.exists()
    except OSError as error:  # such as a name that is too long
        raise UserError(f"{FLAG} {str(path)!r} cannot be read: {error.strerror}") from None
    if not exists:
        raise UserError(f"{FLAG}: there is no {path}")
    if (data := find_minari(path)) is not None:
        return [MinariDataset(path, data)]
    if path.is_file():
        return [EpisodeFile(path)]
    if (path / INFO).is_file():
        return [LeRobotDataset(path)]
    files = list_episode_files(path)
    if not files:
        raise UserError(
            f"{FLAG}: {path} holds no recorded episodes: neither files *.hdf5 of collection.keep_episodes, nor a "
            "Minari dataset (data/metadata.json), nor a LeRobot dataset (meta/info.json)"
        )
    return [EpisodeFile(file) for file in files]
