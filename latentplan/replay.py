"""Replay: episodes in, sequence batches out.

Each environment writes its own lane, one row per frame. A row holds the frame, the belief's deterministic state
at that frame, the action taken there, and the reward and continuation that arrived with the next frame; the last
row of an episode has no action. Alignment is drawn at the top of a batch: observations are one longer than actions.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from latentplan.config import UserError

FRAME_SHAPE = (64, 64, 3)
MEMORY_SHARE = 0.9
SAMPLING_ROUNDS = 1000


@dataclass
class Rows:
    """Consecutive rows of one lane, as collected: arrays of length n, or (n, ...).

    Attributes:
        frames: uint8 (n, 64, 64, 3).
        deter: Belief at each frame, float (n, deter).
        actions: Executed actions in [-1, 1], float32 (n, action); zeros on an episode's last row.
        rewards: Arriving with the next frame, float32 (n,).
        continues: 1 unless the episode ended in a terminal state with the next frame, float32 (n,).
        is_first: Whether an episode starts at this row, bool (n,).
    """

    frames: np.ndarray
    deter: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    continues: np.ndarray
    is_first: np.ndarray


class Batch(NamedTuple):
    """Sequences of `time` decisions and `time + 1` frames.

    Attributes:
        frames: uint8 (batch, time + 1, 64, 64, 3).
        deter: Belief at the first frame, float32 (batch, deter).
        actions: actions[t] was taken at frames[t], (batch, time, action).
        rewards: rewards[t] arrived with frames[t + 1], (batch, time).
        continues: Whether the episode went on at frames[t + 1], (batch, time).
        rows: Where each frame lives in replay, (batch, time + 1), for `Replay.refresh`.
    """

    frames: Tensor
    deter: Tensor
    actions: Tensor
    rewards: Tensor
    continues: Tensor
    rows: Tensor


class Replay:
    """A preallocated ring of rows per environment.

    Args:
        capacity: Rows in all, split evenly over lanes.
        action_dim: Size of the action.
        deter_dim: Size of the stored belief.
        num_lanes: Environments that write.
        device: Where the rows live and batches are gathered.

    Raises:
        UserError: The rows do not fit into nine tenths of the memory that is free.
    """

    def __init__(self, capacity: int, action_dim: int, deter_dim: int, num_lanes: int, device: torch.device) -> None:
        self.lane_size = -(-capacity // num_lanes)
        self.num_lanes, self.device = num_lanes, device
        total = self.lane_size * num_lanes
        self.num_bytes = replay_bytes(total, action_dim, deter_dim)
        _check_memory(self.num_bytes, device)
        self.frames = torch.zeros(total, *FRAME_SHAPE, dtype=torch.uint8, device=device)
        self.deter = torch.zeros(total, deter_dim, dtype=torch.float16, device=device)
        self.actions = torch.zeros(total, action_dim, device=device)
        self.rewards = torch.zeros(total, device=device)
        self.continues = torch.ones(total, device=device)
        self.episode = np.full((num_lanes, self.lane_size), -1, dtype=np.int64)
        self.written = np.zeros(num_lanes, dtype=np.int64)
        self._saved = np.zeros(num_lanes, dtype=np.int64)

    def __len__(self) -> int:
        """Rows held."""
        return int(np.minimum(self.written, self.lane_size).sum())

    def add(self, lane: int, rows: Rows) -> None:
        """Append consecutive rows to a lane, overwriting its oldest when it is full."""
        count = len(rows.frames)
        positions = (self.written[lane] + np.arange(count)) % self.lane_size
        previous = self.episode[lane, (self.written[lane] - 1) % self.lane_size] if self.written[lane] else -1
        self.episode[lane, positions] = previous + np.cumsum(rows.is_first)
        index = torch.as_tensor(positions + lane * self.lane_size, device=self.device)
        for name in ("frames", "deter", "actions", "rewards", "continues"):
            store = getattr(self, name)
            store[index] = torch.as_tensor(getattr(rows, name), device=self.device).to(store.dtype)
        self.written[lane] += count

    def sample(self, batch_size: int, sequence_length: int, rng: np.random.Generator) -> Batch:
        """Uniformly drawn sequences, each within one episode.

        Raises:
            UserError: No episode is long enough.
        """
        lanes, starts = self._draw_starts(batch_size, sequence_length, rng)
        steps = np.arange(sequence_length + 1)
        positions = (starts[:, None] + steps) % self.lane_size + (lanes * self.lane_size)[:, None]
        rows = torch.as_tensor(positions, device=self.device)
        acted = rows[:, :-1]
        return Batch(
            frames=self.frames[rows],
            deter=self.deter[rows[:, 0]].float(),
            actions=self.actions[acted],
            rewards=self.rewards[acted],
            continues=self.continues[acted],
            rows=rows,
        )

    def refresh(self, rows: Tensor, deter: Tensor) -> None:
        """Replace the stored beliefs at rows (batch, time) with newer ones (batch, time, deter)."""
        self.deter[rows.flatten()] = deter.flatten(0, 1).to(self.deter.dtype)

    def save(self, folder: Path) -> None:
        """Write what is new since the last save; `load` restores exactly what the last whole save held."""
        folder.mkdir(parents=True, exist_ok=True)
        for lane in range(self.num_lanes):
            first = max(self._saved[lane], self.written[lane] - self.lane_size)
            path = folder / f"frames_{lane}.u8"
            path.touch()
            with path.open("r+b") as file:
                for position in range(first, self.written[lane]):
                    slot = position % self.lane_size
                    file.seek(slot * int(np.prod(FRAME_SHAPE)))
                    file.write(self.frames[lane * self.lane_size + slot].cpu().numpy().tobytes())
        parts = {name: getattr(self, name).cpu() for name in ("deter", "actions", "rewards", "continues")}
        state = parts | {"episode": torch.from_numpy(self.episode), "written": torch.from_numpy(self.written)}
        torch.save(state, folder / "rows.pt.part")
        (folder / "rows.pt.part").replace(folder / "rows.pt")
        (folder / "shape.json").write_text(json.dumps({"lane_size": self.lane_size, "num_lanes": self.num_lanes}))
        self._saved = self.written.copy()

    def load(self, folder: Path) -> None:
        """Restore what `save` wrote, into a replay of at least the same lane size.

        Raises:
            UserError: The folder holds no replay of the same number of lanes.
        """
        if not (folder / "rows.pt").exists():
            raise UserError(f"no replay found in {folder}")
        shape = json.loads((folder / "shape.json").read_text())
        if shape["num_lanes"] != self.num_lanes or shape["lane_size"] != self.lane_size:
            raise UserError(f"the replay in {folder} has another shape: {shape}")
        state = torch.load(folder / "rows.pt", weights_only=True)
        for name in ("deter", "actions", "rewards", "continues"):
            getattr(self, name).copy_(state[name])
        self.episode, self.written = state["episode"].numpy(), state["written"].numpy()
        self._saved = self.written.copy()
        for lane in range(self.num_lanes):
            count = int(min(self.written[lane], self.lane_size))
            frames = np.fromfile(folder / f"frames_{lane}.u8", np.uint8, count * int(np.prod(FRAME_SHAPE)))
            first = lane * self.lane_size
            self.frames[first : first + count] = torch.from_numpy(frames.reshape(count, *FRAME_SHAPE))

    def _draw_starts(self, count: int, length: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        held = np.minimum(self.written, self.lane_size)
        oldest = self.written - held
        lanes, starts = np.empty(0, np.int64), np.empty(0, np.int64)
        for _ in range(SAMPLING_ROUNDS):
            lane = rng.choice(self.num_lanes, size=2 * count, p=held / held.sum())
            offset = rng.integers(0, held[lane])
            fits = offset + length < held[lane]
            start = oldest[lane] + offset
            same = self.episode[lane, start % self.lane_size] == self.episode[lane, (start + length) % self.lane_size]
            keep = fits & same
            lanes, starts = np.concatenate([lanes, lane[keep]]), np.concatenate([starts, start[keep]])
            if len(starts) >= count:
                return lanes[:count], starts[:count]
        raise UserError(f"no episode in replay is longer than sequence_length ({length}) decisions")


def replay_bytes(num_rows: int, action_dim: int, deter_dim: int) -> int:
    """Memory that a replay of `num_rows` rows takes, in bytes."""
    return num_rows * (int(np.prod(FRAME_SHAPE)) + 2 * deter_dim + 4 * action_dim + 4 + 4 + 8)


def _check_memory(num_bytes: int, device: torch.device) -> None:
    free = torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else _free_memory()
    if num_bytes > MEMORY_SHARE * free:
        raise UserError(
            f"the replay takes {num_bytes / 2**30:.1f} GiB but {device.type} has {free / 2**30:.1f} GiB free: "
            "lower --replay.capacity or --frames"
        )


def _free_memory() -> int:
    with open("/proc/meminfo") as file:
        for line in file:
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    raise UserError("cannot read the free memory of this machine")
