"""Recorded episodes, whatever wrote them: what a recording says of itself, and the episodes in it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import gymnasium
import numpy as np

from latentplan.config import UserError
from latentplan.envs.spaces import ONLY_PICTURE, is_picture


@dataclass(frozen=True)
class RecordedEpisode:
    """One episode of n decisions, in the units of its environment.

    Attributes:
        observations: Pictures and vectors by name, each (n + 1, ...).
        actions: All numbers of the action space side by side (see `latentplan.envs.spaces.Actions`), float64 (n, own
            number).
        rewards: Reward of each decision, float64 (n,).
        is_terminal: Whether the last decision led to a terminal state; if not, the episode was cut.
        quantities: True quantities at each frame, float32 (n + 1, quantity); None without any.
    """

    observations: dict[str, np.ndarray]
    actions: np.ndarray
    rewards: np.ndarray
    is_terminal: bool
    quantities: np.ndarray | None = None


class Recording(Protocol):
    """Episodes of one environment in one file or folder.

    Attributes:
        path: The file or folder.
        space: Spaces of pictures and vectors by name.
        bounds: `Actions.bounds` of the environment, float64 (3, own number); None where nothing tells them.
        num_numbers: Numbers of an action.
        quantities: Names of the true quantities that are recorded with each frame.
        action_repeat: Steps of the environment for which an action was held.
        is_own: Whether this project wrote the recording, so that its names are those of a run.
        origin: The environment, for warnings; empty where nothing tells it.
        lengths: Decisions of each episode.
    """

    path: Path
    space: gymnasium.spaces.Dict
    bounds: np.ndarray | None
    num_numbers: int
    quantities: tuple[str, ...]
    action_repeat: int
    is_own: bool
    origin: str
    lengths: list[int]

    def read(self, index: int) -> RecordedEpisode:
        """An episode.

        Raises:
            UserError: The recording is damaged.
        """


def describe_damage(path: Path, kind: str, error: Exception) -> UserError:
    """One line for a dataset that raised an error when it was read as its kind, such as `a Minari dataset`."""
    reason = " ".join(str(error).split())[:200] or type(error).__name__
    return UserError(f"{path} cannot be read as {kind}: {reason}")


def name_space(path: Path, space: gymnasium.Space[Any]) -> gymnasium.spaces.Dict:
    """An observation space as a Dict; a picture alone gets the name that it has in an environment.

    Raises:
        UserError: The space holds no picture.
    """
    parts = space.spaces if isinstance(space, gymnasium.spaces.Dict) else {ONLY_PICTURE: space}
    if not any(is_picture(part) for part in parts.values()):
        kinds = ", ".join(f"{name} {part.shape}" for name, part in list(parts.items())[:5])
        raise UserError(
            f"{path} holds no pictures, only {kinds}: record it again with pictures in its observations, for instance "
            "by gymnasium.wrappers.AddRenderObservation(env, render_only=False) around its environment"
        )
    return gymnasium.spaces.Dict(dict(parts))
