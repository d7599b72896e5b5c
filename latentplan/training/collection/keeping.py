"""Keeps episodes as files: those that a run collects, and those that anything else plays in an environment."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from latentplan.config import USER_DOMAIN, Config, EnvConfig, UserError, make_folder
from latentplan.config.extras import require_extra
from latentplan.config.files import read_config
from latentplan.config.run_folder import try_lock
from latentplan.envs.registry import default_task
from latentplan.envs.spaces import Actions, Interface
from latentplan.envs.user import PixelEnv
from latentplan.envs.vector import read_own_facts
from latentplan.training.demonstrations.episode_file import write_episode
from latentplan.training.demonstrations.fitting import read_interface
from latentplan.training.demonstrations.kinds import SUFFIX, list_episode_files
from latentplan.training.demonstrations.recording import RecordedEpisode

SETTING = "collection.keep_episodes"


class EpisodeKeeper:
    """Remembers the running episode of each environment, and writes it when it has ended.

    A file is named by the environment and the number of its episode, so that a run which repeats an episode after it
    was killed writes the same file again.

    Args:
        folder: Folder of the files; made if needed.
        env: Settings of the environments.
        interface: What an environment shows and takes.
        labels: Names of the true quantities that come with each frame.
        num_envs: Number of environments.

    Raises:
        UserError: The folder cannot be made, or a file cannot hold the names of pictures and vectors.
    """

    def __init__(
        self, folder: Path, env: EnvConfig, interface: Interface, labels: tuple[str, ...], num_envs: int
    ) -> None:
        require_extra("keeping episodes", "h5py")
        _check_names([*interface.pictures, *(name for name, _ in interface.vectors)])
        make_folder(folder)
        self.folder, self._env, self._interface, self._quantities = folder, env, interface, labels
        self._actions = Actions(interface.action_space)
        self._moments: list[list[tuple[np.ndarray, np.ndarray]]] = [[] for _ in range(num_envs)]
        self._decisions: list[list[tuple[np.ndarray, float, bool]]] = [[] for _ in range(num_envs)]

    def begin(self, where: np.ndarray, frames: np.ndarray, labels: np.ndarray | None) -> None:
        """Begins new episodes.

        Args:
            where: Environments that were reset, bool (env,).
            frames: Frames of all environments, uint8 (env, height, width, 3 * camera).
            labels: Quantities and vectors at these frames, (env, label); None without any.
        """
        for lane in np.flatnonzero(where).tolist():
            self._moments[lane], self._decisions[lane] = [_moment(lane, frames, labels)], []

    def add(
        self,
        actions: np.ndarray,
        frames: np.ndarray,
        rewards: np.ndarray,
        terminated: np.ndarray,
        labels: np.ndarray | None,
    ) -> None:
        """Adds one step of every environment: actions (env, action) in [-1, 1], and what they led to."""
        for lane, decisions in enumerate(self._decisions):
            decisions.append((np.array(actions[lane]), float(rewards[lane]), bool(terminated[lane])))
            self._moments[lane].append(_moment(lane, frames, labels))

    def write(self, lane: int, number: int) -> None:
        """Writes the episode of an environment, which has ended.

        Args:
            lane: Index of the environment.
            number: Number of its episode.

        Raises:
            UserError: The file cannot be written.
        """
        frames, labels = (np.stack(part) for part in zip(*self._moments[lane], strict=True))
        actions, rewards, terminated = zip(*self._decisions[lane], strict=True)
        pictures = np.split(frames, len(self._interface.pictures), axis=-1)
        observations = dict(zip(self._interface.pictures, pictures, strict=True))
        place = len(self._quantities)
        for name, size in self._interface.vectors:
            observations[name] = labels[:, place : place + size]
            place += size
        episode = RecordedEpisode(
            observations,
            self._actions.to_own(np.stack(actions).astype(np.float64)),
            np.array(rewards, np.float64),
            terminated[-1],
            labels[:, : len(self._quantities)] if self._quantities else None,
        )
        path = self.folder / f"episode-{lane:03d}-{number:06d}{SUFFIX}"
        write_episode(path, episode, self._interface, self._quantities, self._env)


class KeepingEnv(gymnasium.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray]):
    """An environment that keeps every episode that ends, whoever acts in it.

    Args:
        env: An environment of `latentplan.envs.make_env` or `latentplan.envs.wrap_user_env`.
        folder: Folder of the files; made if needed.
        config: Settings of the environment.
        name: What names the folder, for errors.

    Raises:
        UserError: The folder cannot be made, or holds episodes already.
    """

    def __init__(
        self, env: gymnasium.Env[np.ndarray, np.ndarray], folder: Path | str, config: EnvConfig, name: str = "folder"
    ) -> None:
        super().__init__(env)
        with contextlib.ExitStack() as lock:
            lock.enter_context(keep_alone(Path(folder)))
            refuse_used_folder(Path(folder), name)
            self._lock = lock.pop_all()
        facts = read_own_facts(env)
        if isinstance(env.unwrapped, PixelEnv) and config.suite == EnvConfig.suite:  # of `wrap_user_env`
            config = replace(config, domain=USER_DOMAIN)
        elif config.task is None:
            config = replace(config, task=default_task(config.domain, config.suite))
        self._keeper = EpisodeKeeper(Path(folder), config, read_interface(facts), tuple(facts["labels"] or ()), 1)
        self._number = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begins an episode; one that has not ended is not kept."""
        frame, info = self.env.reset(seed=seed, options=options)
        self._number += 1
        self._keeper.begin(np.ones(1, bool), frame[None], _known(info))
        return frame, info

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Steps the environment, and writes the episode if it has ended."""
        frame, reward, terminated, truncated, info = self.env.step(action)
        ends = np.array([terminated])
        clipped = np.clip(np.asarray(action, np.float32), -1.0, 1.0)
        self._keeper.add(clipped[None], frame[None], np.array([reward], np.float64), ends, _known(info))
        if terminated or truncated:
            self._keeper.write(0, self._number)
        return frame, reward, bool(terminated), bool(truncated), info

    def close(self) -> None:
        """Closes the environment; from then on others may keep episodes in the folder."""
        self._lock.close()
        super().close()


@contextlib.contextmanager
def keep_alone(folder: Path | str | None) -> Iterator[None]:
    """A context in which nobody else keeps episodes in a folder, whose files would have the same names.

    On a file system without locks the folder stays unlocked.

    Args:
        folder: The folder; made if needed. None keeps no episodes.

    Raises:
        UserError: Another run or environment keeps its episodes there, or the folder cannot be made.
    """
    if folder is None:
        yield
        return
    make_folder(Path(folder))
    opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        with contextlib.suppress(OSError):
            if not try_lock(opened):
                raise UserError(
                    f"something else keeps its episodes in {folder}: end it first, or choose another folder"
                )
        yield
    finally:
        os.close(opened)


def refuse_used_folder(folder: Path, name: str = SETTING) -> None:
    """Refuses a folder that holds episodes of another run.

    Args:
        folder: The folder.
        name: What names it, for the error.

    Raises:
        UserError: The folder holds episodes.
    """
    if folder.is_dir() and list_episode_files(folder):
        raise UserError(f"{folder} already holds recorded episodes: choose another folder to keep episodes in ({name})")


def _check_names(names: Sequence[Any]) -> None:
    """Refuses names of observations that are no names of HDF5, where a slash begins a group."""
    for name in names:
        parts = name.split("/") if isinstance(name, str) else [""]
        if not set(parts).isdisjoint(("", ".", "..")):
            raise UserError(f"episodes cannot be kept: a file cannot hold an observation of the name {name!r}")
        if any(other != name and str(other).startswith(f"{name}/") for other in names):
            raise UserError(f"episodes cannot be kept: the observation {name!r} is named like a folder of others")


def begin_keeping(config: Config) -> Config:
    """The settings of a new run with the whole path of the folder of its episodes, so that it resumes from anywhere.

    Raises:
        UserError: The folder holds episodes.
    """
    folder = config.collection.keep_episodes
    if folder is None:
        return config
    refuse_used_folder(Path(folder))
    return replace(config, collection=replace(config.collection, keep_episodes=os.path.abspath(folder)))


def check_kept(config: Config, copy: Path | None, *, has_other_ranks: bool) -> None:
    """Refuses a run that resumes and would replace episodes that are kept.

    A run that resumes repeats the episodes after its last save, and replaces their files by equal ones. In a folder
    that it has not used, or with another number of processes, it would replace other episodes.

    Args:
        config: Settings of the run.
        copy: File of its settings in its last save; None where there is none.
        has_other_ranks: Whether another number of processes learns than before.

    Raises:
        UserError: The folder of kept episodes holds episodes of another run.
    """
    folder = config.collection.keep_episodes
    if folder is None:
        return
    if has_other_ranks or copy is None or read_config(copy).collection.keep_episodes != folder:
        refuse_used_folder(Path(folder))


def _known(info: dict[str, Any]) -> np.ndarray | None:
    """Quantities and vectors of an environment's info, (1, label); None without any."""
    known = [info[name] for name in ("labels", "vectors") if info.get(name) is not None]
    return np.concatenate(known)[None] if known else None


def _moment(lane: int, frames: np.ndarray, labels: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    known = np.zeros(0, np.float32) if labels is None else np.array(labels[lane], np.float32)
    return frames[lane].copy(), known
