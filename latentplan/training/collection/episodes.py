"""The running episodes of collection: each has its own seed and a record of its actions, so that it can be repeated."""

from __future__ import annotations

import warnings
import zlib
from typing import Any

import numpy as np
import torch
from gymnasium.vector import VectorEnv

from latentplan.config import derive_seed
from latentplan.training.collection.keeping import EpisodeKeeper


class Stopped(Exception):
    """A round was given up, because the run stops; a resumed run repeats the round."""


class Episodes:
    """Starts and steps several environments, and keeps a record of every running episode.

    An episode's start depends only on the seed of the run, its environment, its number, and the resets that failed
    before it. Its seed and its actions therefore bring another environment into the same state, if the environment
    depends on nothing else.

    Args:
        envs: The environments.
        seed: Seed of the run.
        keeper: Keeps the episodes that end in `step`; None keeps none. An episode that a fault cut is not kept.
        cut: Decisions after which a short episode is truncated.
        short_share: Share of each environment's decisions that belong to short episodes, in [0, 1].
    """

    def __init__(
        self,
        envs: VectorEnv[np.ndarray, np.ndarray, Any],
        seed: int,
        keeper: EpisodeKeeper | None = None,
        cut: int = 0,
        short_share: float = 0.0,
    ) -> None:
        self.envs, self.seed, self.keeper = envs, seed, keeper
        self._cut, self._short_share = cut, short_share
        self.is_short = np.zeros(envs.num_envs, dtype=bool)  # of the latest episode of each environment
        self._played = np.zeros((envs.num_envs, 2), dtype=np.int64)  # decisions of whole and of short episodes
        self._begun = [0] * envs.num_envs  # episodes so far, of each environment
        self._actions: list[list[np.ndarray]] = [[] for _ in range(envs.num_envs)]
        self._is_started = False
        self._over = np.zeros(envs.num_envs, dtype=bool)  # while episodes are repeated

    def restart(self, where: np.ndarray) -> tuple[np.ndarray, dict[str, Any]]:
        """Begins the next episode in some environments.

        Args:
            where: The environments, bool (env,); all of them at the first call.

        Returns:
            Frames of all environments, uint8 (env, height, width, 3 * camera), and the infos of those that began.
        """
        for lane in np.flatnonzero(where):
            self._begun[lane] += 1
            self._actions[lane].clear()
            whole, short = self._played[lane]
            self.is_short[lane] = short < self._short_share * (whole + short) or self._short_share == 1.0
        return self._reset(where)

    def step(self, actions: np.ndarray) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """The result of one step of all environments with actions (env, action)."""
        for record, action in zip(self._actions, actions, strict=True):
            record.append(np.array(action))
        frames, rewards, terminated, truncated, info = self._step(actions)
        self._played[np.arange(len(self._played)), self.is_short.astype(int)] += 1
        is_long = np.array([len(record) >= self._cut for record in self._actions])
        truncated = truncated | (self.is_short & is_long & ~terminated)
        if self.keeper is not None:
            for lane in np.flatnonzero((terminated | truncated) & ~info["failed"]).tolist():
                self.keeper.write(lane, self._begun[lane])
        return frames, rewards, terminated, truncated, info

    def memory(self, frames: np.ndarray, has_ended: np.ndarray) -> list[dict[str, Any]]:
        """The record of each environment's running episode, for `replay`.

        Args:
            frames: The present frames, uint8 (env, height, width, 3 * camera).
            has_ended: Environments whose episode is over, bool (env,).
        """
        size = self.envs.single_action_space.shape or ()
        return [
            {
                "begun": begun,
                "is_short": is_short,
                "played": played.copy(),
                "actions": np.stack(record) if record and not over else np.zeros((0, *size), np.float32),
                "frame": zlib.crc32(frame.tobytes()),
            }
            for begun, is_short, played, record, frame, over in zip(
                self._begun, self.is_short.tolist(), self._played, self._actions, frames, has_ended, strict=True
            )
        ]

    def replay(self, records: list[dict[str, Any]]) -> tuple[np.ndarray, Any, np.ndarray]:
        """Plays recorded episodes again; the shorter ones begin later, so that all arrive at the same time.

        Args:
            records: What `memory` returned; records without actions stand for episodes that are over.

        Returns:
            The present frames, uint8 (env, height, width, 3 * camera), the present labels, and whether each
            environment has repeated its episode, bool (env,).
        """
        self._begun = [record["begun"] for record in records]
        self.is_short = np.array([record.get("is_short", False) for record in records])  # earlier saves have none
        self._played = np.array([record["played"].tolist() if "played" in record else (0, 0) for record in records])
        actions = [record["actions"].numpy() for record in records]
        lengths = np.array([len(taken) for taken in actions])
        is_same = np.ones(len(records), dtype=bool)
        frames, info = self._reset(np.ones(len(records), dtype=bool))
        for time in range(longest := int(lengths.max(initial=0))):
            place = time - (longest - lengths)  # of each episode; before 0 the environment waits and plays anything
            begins = (place == 0) | (self._over)
            if time and begins.any():
                frames, _ = self._reset(begins)
            taken = [
                own[at] if at >= 0 else np.zeros(own.shape[1:], np.float32)
                for own, at in zip(actions, place, strict=True)
            ]
            frames, _, terminated, truncated, info = self._step(np.stack(taken))
            self._over = np.asarray(terminated) | np.asarray(truncated)
            is_same &= ~(self._over & (place >= 0))
        self._actions = [list(taken) for taken in actions]
        sums = np.array([zlib.crc32(frame.tobytes()) for frame in frames])
        is_same &= (sums == np.array([record["frame"] for record in records])) | (lengths == 0)
        if not is_same.all():
            warnings.warn(
                f"{(~is_same).sum()} of {len(is_same)} environments did not repeat their episode from its seed and its "
                "actions: new episodes begin there, and the run is no longer equal to an uninterrupted one",
                RuntimeWarning,
                stacklevel=2,
            )
        return frames, info.get("labels"), is_same

    def _reset(self, where: np.ndarray) -> tuple[np.ndarray, dict[str, Any]]:
        seeds: Any = [derive_seed(self.seed, f"episodes {lane}", begun) for lane, begun in enumerate(self._begun)]
        self._over = np.zeros(len(seeds), dtype=bool)
        options = {"reset_mask": where} if self._is_started else None
        self._is_started = True
        frames, info = self.envs.reset(seed=seeds, options=options)
        if self.keeper is not None:
            self.keeper.begin(where, frames, info.get("labels"))
        return frames, info

    def _step(self, actions: np.ndarray) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """One step of all environments, which the keeper of episodes remembers."""
        frames, rewards, terminated, truncated, info = self.envs.step(actions)
        if self.keeper is not None:
            self.keeper.add(actions, frames, rewards, terminated, info.get("labels"))
        return frames, rewards, terminated, truncated, info


def to_arrays(value: Any) -> Any:
    """Nested dictionaries and lists with their tensors as NumPy arrays; bfloat16 becomes float32."""
    if isinstance(value, dict):
        return {name: to_arrays(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [to_arrays(inner) for inner in value]
    if isinstance(value, torch.Tensor):
        return (value.float() if value.dtype == torch.bfloat16 else value).numpy()
    return value


def to_tensors(value: Any) -> Any:
    """Nested dictionaries and lists with their NumPy arrays as tensors, which `torch.save` writes as plain data."""
    if isinstance(value, dict):
        return {name: to_tensors(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [to_tensors(inner) for inner in value]
    if isinstance(value, np.ndarray):
        return torch.from_numpy(np.ascontiguousarray(value).copy())
    return value
