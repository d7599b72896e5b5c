"""The rows of one round of collection."""

from __future__ import annotations

from typing import Any

import numpy as np

from latentplan.replay.buffer import Rows


class RoundLog:
    """Collects the rows of every environment during one round.

    Args:
        lanes: Number of environments.
        action_dim: Size of the action.
        deter_dim: Size of the belief that is kept with each frame.

    Attributes:
        returns: Returns of the episodes that ended.
        env_frames: Simulator control steps so far.
    """

    def __init__(self, lanes: int, action_dim: int, deter_dim: int) -> None:
        self._lanes: list[list[tuple[Any, ...]]] = [[] for _ in range(lanes)]
        self._no_deter = np.zeros((lanes, deter_dim), np.float32)
        self._no_action = np.zeros(action_dim, np.float32)
        self.returns: list[float] = []
        self.env_frames = 0

    def append(
        self,
        frames: np.ndarray,
        deter: np.ndarray | None,
        actions: np.ndarray,
        rewards: np.ndarray,
        continues: np.ndarray,
        first: np.ndarray,
        labels: np.ndarray,
        env_frames: np.ndarray,
        failed: np.ndarray,
    ) -> None:
        """Adds one step of all environments; every argument has one entry per environment."""
        beliefs = self._no_deter if deter is None else deter
        actions = np.where(
            failed[:, None], self._no_action, actions
        )  # of a step that failed, the next frame is unknown
        for lane, entries in enumerate(self._lanes):
            row = (frames, beliefs, actions, rewards, continues.astype(np.float32), first, labels)
            entries.append(tuple(part[lane] for part in row))
        self.env_frames += int(env_frames.sum())

    def finish(self, lane: int, frame: np.ndarray, labels: np.ndarray) -> None:
        """Adds the last frame of an episode that ended."""
        self._lanes[lane].append((frame, self._no_deter[lane], self._no_action, 0.0, 1.0, False, labels))

    def rows(self) -> list[Rows]:
        """The rows of each environment in the order of time."""
        return [_stack(entries) for entries in self._lanes]


def _stack(entries: list[tuple[Any, ...]]) -> Rows:
    frames, deter, actions, rewards, continues, is_first, labels = zip(*entries, strict=True)
    return Rows(
        frames=np.stack(frames),
        deter=np.stack(deter),
        actions=np.stack(actions),
        rewards=np.asarray(rewards, np.float32),
        continues=np.asarray(continues, np.float32),
        is_first=np.asarray(is_first, bool),
        labels=np.stack(labels),
    )
