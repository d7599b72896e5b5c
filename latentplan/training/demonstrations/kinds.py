"""Tells what wrote a recording from the names of its files, without the libraries that read it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Literal, NamedTuple

from latentplan.config import UserError

FLAG = "--replay.demonstrations"
SUFFIX = ".hdf5"  # of this project's episode files
BELOW = ("", "worker-*/", "rank-*/", "rank-*/worker-*/")  # folders of one run's workers and processes
METADATA = "metadata.json"  # of a Minari dataset
SIGNATURE = b"\x89HDF\r\n\x1a\n"  # of an HDF5 file
INFO = "meta/info.json"  # of a LeRobot dataset


class Recorded(NamedTuple):
    """A file or folder with recorded episodes.

    Attributes:
        kind: What wrote it.
        paths: Episode files; or the one folder with the metadata of a Minari dataset; or that of a LeRobot dataset.
    """

    kind: Literal["episodes", "minari", "lerobot"]
    paths: list[Path]


def find_recordings(names: Iterable[str]) -> list[Recorded]:
    """What wrote each file or folder.

    Args:
        names: The files and folders.

    Raises:
        UserError: One of them does not exist, or is no recording.
    """
    return [_find(Path(name)) for name in names]


def list_episode_files(folder: Path) -> list[Path]:
    """The episode files of a folder in the order of their names, then those of other workers and processes below it."""
    return [path for below in BELOW for path in sorted(folder.glob(f"{below}*{SUFFIX}")) if path.is_file()]


def _find(path: Path) -> Recorded:
    try:
        exists = path.exists()
    except OSError as error:  # such as a name that is too long
        raise UserError(f"{FLAG} {str(path)!r} cannot be read: {error.strerror}") from None
    if not exists:
        raise UserError(f"{FLAG}: there is no {path}")
    folder = path.parent if path.is_file() and path.name.startswith("main_data.") else path
    for found in (folder / "data", folder):
        if (found / METADATA).is_file():
            return Recorded("minari", [found])
    if path.is_file():
        with path.open("rb") as file:
            if file.read(len(SIGNATURE)) != SIGNATURE:
                raise UserError(f"{FLAG}: {path} is no HDF5 file, or is damaged")
        return Recorded("episodes", [path])
    if (path / INFO).is_file():
        return Recorded("lerobot", [path])
    files = list_episode_files(path) if path.is_dir() else []
    if not files:
        raise UserError(
            f"{FLAG}: {path} holds no recorded episodes: neither files *.hdf5 of collection.keep_episodes, nor a "
            "Minari dataset (data/metadata.json), nor a LeRobot dataset (meta/info.json)"
        )
    return Recorded("episodes", files)
