"""Recordings of Minari: folders with `data/metadata.json` and `data/main_data.hdf5`, read by the package itself."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from latentplan.config import UserError
from latentplan.config.extras import require_extra
from latentplan.envs.spaces import ONLY_PICTURE, Actions
from latentplan.training.demonstrations.kinds import METADATA
from latentplan.training.demonstrations.recording import RecordedEpisode, describe_damage, name_space

USER = "a Minari dataset"
KEYS = ("observation_space", "action_space", "minari_version")


class MinariDataset:
    """The episodes of a Minari dataset; see `Recording`.

    An action of a Minari dataset is held for one step of its environment.

    Args:
        path: Folder of the dataset.
        data: Its folder with the metadata.

    Raises:
        UserError: The dataset cannot be read, or shows no pictures.
    """

    quantities: tuple[str, ...] = ()
    action_repeat, is_own = 1, False

    def __init__(self, path: Path, data: Path) -> None:
        self.path = path
        require_extra(USER, "minari", "h5py")
        import minari
        from minari.dataset.minari_storage import MinariStorage

        try:
            metadata = json.loads((data / METADATA).read_text())
            missing = [key for key in KEYS if key not in metadata]  # Minari would make the environment to ask it
            if missing:
                raise ValueError(f"{METADATA} lacks {', '.join(missing)}")
            if (version := metadata["minari_version"]) not in minari.supported_dataset_versions:
                raise ValueError(f"Minari {version} wrote it, and Minari {minari.__version__} cannot read that")
            self._storage = MinariStorage.read(data)
            steps = self._storage.get_episode_metadata(range(self._storage.total_episodes))
            self.lengths = [int(entry["total_steps"]) for entry in steps]
        except Exception as error:  # files of others, read by another package, may raise anything
            raise describe_damage(path, USER, error) from None
        self._is_single = not isinstance(self._storage.observation_space, gymnasium.spaces.Dict)
        named = name_space(path, self._storage.observation_space).spaces
        nested = gymnasium.spaces.Dict, gymnasium.spaces.Tuple  # of which nothing can be learned
        self.space = gymnasium.spaces.Dict({key: part for key, part in named.items() if not isinstance(part, nested)})
        self._action_space = self._storage.action_space
        try:
            self.bounds: np.ndarray | None = Actions(self._action_space).bounds
        except UserError:  # of a space without bounds, or of another kind
            self.bounds = None
        sizes = self._action_space.shape
        self.num_numbers = int(np.prod(sizes or (1,))) if self.bounds is None else self.bounds.shape[1]
        self.origin = str(metadata.get("dataset_id", ""))

    def read(self, index: int) -> RecordedEpisode:
        """An episode."""
        try:
            (found,) = self._storage.get_episodes([index])
            actions = _flatten(self._action_space, found["actions"])
        except Exception as error:
            raise describe_damage(self.path, USER, error) from None
        seen = {ONLY_PICTURE: found["observations"]} if self._is_single else found["observations"]
        seen = {name: values for name, values in seen.items() if name in self.space.spaces}
        rewards = np.asarray(found["rewards"], np.float64)
        lengths = {len(values) - 1 for values in seen.values()}
        if lengths | {len(actions), len(rewards)} != {self.lengths[index]}:
            raise UserError(
                f"{self.path} is damaged: episode {index} must have {self.lengths[index]} actions and one observation "
                "more"
            )
        return RecordedEpisode(seen, actions, rewards, bool(found["terminations"][-1]))


def _flatten(space: Any, values: Any) -> np.ndarray:
    """Actions as numbers, float64 (time, own number)."""
    try:
        return Actions(space).flatten(values)
    except ValueError as error:
        if not isinstance(space, gymnasium.spaces.Box):
            raise ValueError(f"its actions are {error}") from None
    return np.asarray(values, np.float64).reshape(len(values), -1)
