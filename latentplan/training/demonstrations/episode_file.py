"""This project's own recordings: one HDF5 file for each episode; `docs/reference/episode-files.md` describes them."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from latentplan import __version__
from latentplan.config import EnvConfig, UserError
from latentplan.config.extras import import_extra
from latentplan.config.manifest import write_synced
from latentplan.config.writing import replaced_whole
from latentplan.envs.spaces import Actions, Interface
from latentplan.training.demonstrations.recording import RecordedEpisode, name_space

FORMAT, VERSION = "latentplan-episode", 1
FRAMES_PER_CHUNK = 16
USER = "episode files"
ENVIRONMENT = ("suite", "domain", "task", "objective", "kwargs", "pixels", "action_repeat", "frame_size")


def write_episode(
    path: Path, episode: RecordedEpisode, interface: Interface, quantities: tuple[str, ...], env: EnvConfig
) -> None:
    """Writes an episode under another name, flushes it to the disk and renames it.

    Args:
        path: The file, which is replaced if it exists.
        episode: The episode; its pictures are uint8 (n + 1, height, width, 3).
        interface: What the environment shows and takes.
        quantities: Names of the true quantities.
        env: Settings of the environment.

    Raises:
        UserError: The file cannot be written.
    """
    h5py: Any = import_extra("h5py", USER)
    low, high, categories = Actions(interface.action_space).bounds
    target = io.BytesIO()
    with h5py.File(target, "w") as file:
        file.attrs["format"], file.attrs["version"], file.attrs["latentplan"] = FORMAT, VERSION, __version__
        file.attrs["environment"] = json.dumps({name: getattr(env, name) for name in ENVIRONMENT})
        file.attrs["pictures"] = json.dumps(interface.pictures)
        file.attrs["vectors"] = json.dumps([name for name, _ in interface.vectors])
        for name in interface.pictures:
            pictures = episode.observations[name]
            chunks = (min(FRAMES_PER_CHUNK, len(pictures)), *pictures.shape[1:])
            file.create_dataset(
                f"observations/{name}",
                data=pictures,
                chunks=chunks,
                compression="gzip",
                compression_opts=1,
                fletcher32=True,
            )
        for name, _ in interface.vectors:
            file.create_dataset(f"observations/{name}", data=episode.observations[name])
        if episode.quantities is not None:
            file.create_dataset("quantities", data=episode.quantities).attrs["names"] = json.dumps(quantities)
        actions = file.create_dataset("actions", data=episode.actions)
        actions.attrs["low"], actions.attrs["high"], actions.attrs["categories"] = low, high, categories
        file.create_dataset("rewards", data=episode.rewards)
        is_last = np.arange(len(episode.rewards)) == len(episode.rewards) - 1
        file.create_dataset("terminations", data=is_last & episode.is_terminal)
        file.create_dataset("truncations", data=is_last & (not episode.is_terminal))
    try:
        with replaced_whole(path) as part:
            write_synced(part, target.getvalue())
    except OSError as error:
        raise UserError(f"the episode {path} cannot be written: {error.strerror}; make room, or keep none") from None


class EpisodeFile:
    """The episode in a file that `write_episode` wrote; see `Recording`.

    Args:
        path: The file.

    Raises:
        UserError: The file is no such file, or is damaged.
    """

    is_own = True

    def __init__(self, path: Path) -> None:
        self.path = path
        with _Reading(path) as file:
            if file.attrs.get("format") != FORMAT:
                raise UserError(f"{path} is no episode file of latentplan")
            if (version := int(file.attrs["version"])) > VERSION:
                raise UserError(f"{path} has version {version} of the format, this program reads {VERSION}: update it")
            self._pictures: list[str] = json.loads(file.attrs["pictures"])
            self._vectors: list[str] = json.loads(file.attrs["vectors"])
            environment = json.loads(file.attrs["environment"])
            _refuse_other_files(path, file)
            parts = file["observations"]
            spaces: dict[str, gymnasium.Space[Any]] = {
                name: gymnasium.spaces.Box(0, 255, parts[name].shape[1:], np.uint8) for name in self._pictures
            }
            spaces |= {name: gymnasium.spaces.Box(-np.inf, np.inf, parts[name].shape[1:]) for name in self._vectors}
            self.space = name_space(path, gymnasium.spaces.Dict(spaces))
            actions = file["actions"]
            self.bounds: np.ndarray | None = np.stack([actions.attrs[name] for name in ("low", "high", "categories")])
            self.num_numbers, self.lengths = int(actions.shape[1]), [int(actions.shape[0])]
            names = json.loads(file["quantities"].attrs["names"]) if "quantities" in file else ()
            self.quantities = tuple(names)
            self.action_repeat = int(environment["action_repeat"])
            words = (environment["suite"], environment["domain"], environment["task"])
            self.origin = "-".join(map(str, words))
            if environment["objective"] is not None:
                self.origin += f" with the objective {environment['objective']!r}"

    def read(self, index: int) -> RecordedEpisode:
        """The episode; `index` is 0."""
        with _Reading(self.path) as file:
            episode = RecordedEpisode(
                {name: file["observations"][name][()] for name in (*self._pictures, *self._vectors)},
                file["actions"][()],
                file["rewards"][()],
                bool(file["terminations"][-1]),
                file["quantities"][()] if self.quantities else None,
            )
        lengths = {len(values) - 1 for values in episode.observations.values()} | {len(episode.rewards)}
        if lengths != {self.lengths[index]} or episode.actions.ndim != 2:
            raise UserError(f"{self.path} is damaged: its arrays have other lengths than its {self.lengths[0]} actions")
        return episode


def _refuse_other_files(path: Path, group: Any) -> None:
    """Refuses a file of HDF5 that takes its contents from other files, which a stranger could have named.

    Raises:
        UserError: A part of the file lies elsewhere.
    """
    h5py: Any = import_extra("h5py", USER)
    for name in group:
        link = group.get(name, getlink=True)
        part = None if isinstance(link, h5py.ExternalLink | h5py.SoftLink) else group[name]
        if part is None or (isinstance(part, h5py.Dataset) and (part.external or part.is_virtual)):
            raise UserError(f"{path} takes {name!r} from elsewhere: an episode file holds all of its data itself")
        if isinstance(part, h5py.Group):
            _refuse_other_files(path, part)


class _Reading:
    """An HDF5 file, open to read; errors of the library and missing entries become one line."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> Any:
        h5py: Any = import_extra("h5py", USER)
        try:
            self._file = h5py.File(self._path, "r")
        except OSError:
            raise UserError(f"{self._path} is no HDF5 file, or is damaged") from None
        return self._file

    def __exit__(self, kind: Any, error: Any, traceback: Any) -> None:
        self._file.close()
        if isinstance(error, Exception) and not isinstance(error, UserError):  # damage raises many kinds
            reason = " ".join(str(error).split())[:160]
            raise UserError(f"{self._path} is damaged: {reason}") from None
