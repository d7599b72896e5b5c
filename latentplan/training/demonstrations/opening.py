"""Opens recordings, whatever wrote them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from latentplan.training.demonstrations.episode_file import EpisodeFile
from latentplan.training.demonstrations.kinds import find_recordings
from latentplan.training.demonstrations.lerobot_dataset import LeRobotDataset
from latentplan.training.demonstrations.minari_dataset import MinariDataset
from latentplan.training.demonstrations.recording import Recording


def open_recordings(names: Iterable[str]) -> list[Recording]:
    """Opens files and folders; of a folder of episode files every file.

    Args:
        names: The files and folders.

    Raises:
        UserError: One of them does not exist, is no recording, or is damaged.
    """
    opened: list[Recording] = []
    names = list(names)
    for name, found in zip(names, find_recordings(names), strict=True):
        if found.kind == "minari":
            opened.append(MinariDataset(Path(name), found.paths[0]))
        else:
            opened += map(EpisodeFile if found.kind == "episodes" else LeRobotDataset, found.paths)
    return opened
