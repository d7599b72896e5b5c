"""The replay: stores collected episodes row by row, and returns batches of sequences.

Each environment has its own lane of rows, one row per frame. A row holds the frame, the deterministic state of the
belief at that frame, the action taken there, and the reward and continuation that arrived with the next frame. The last
row of an episode has no action. A sequence in a batch has one frame more than actions; see `Batch`.
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from latentplan.config import UserError
from latentplan.config.manifest import DamageError, write_synced
from latentplan.config.parsing import fits
from latentplan.replay.memory import check_memory, count_replay_bytes

FRAME_SHAPE = (64, 64, 3)
SAMPLING_ROUNDS = 1000
COLUMNS = ("deter", "actions", "rewards", "continues", "labels")


@dataclass
class Rows:
    """Consecutive rows of one lane, as collected: arrays (n, ...).

    Attributes:
        frames: uint8 (n, height, width, 3 * camera).
        deter: Deterministic state of the belief at each frame, float (n, deter).
        actions: Executed actions in [-1, 1], float32 (n, action); zeros on an episode's last row.
        rewards: Rewards that arrived with the next frame, float32 (n,).
        continues: 1 unless the episode ended in a terminal state with the next frame, float32 (n,).
        is_first: Whether an episode starts at this row, bool (n,).
        labels: True quantities at each frame, and then the numbers that the agent sees beside the frame, float32 (n,
            label); (n, 0) if the simulator reports none.
    """

    frames: np.ndarray
    deter: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    continues: np.ndarray
    is_first: np.ndarray
    labels: np.ndarray


class Batch(NamedTuple):
    """Sequences of `time` decisions and `time + 1` frames; frames after a terminal state belong to another episode.

    Attributes:
        frames: uint8 (batch, time + 1, height, width, 3 * camera).
        deter: Deterministic state of the belief at the first frame, float32 (batch, deter).
        actions: actions[t] in [-1, 1] was taken at frames[t], (batch, time, action).
        rewards: rewards[t] arrived with frames[t + 1], (batch, time).
        continues: continues[t] is 0 if frames[t + 1] shows a terminal state, else 1, (batch, time).
        labels: True quantities at each frame, and then the numbers beside it, (batch, time + 1, label).
        rows: Row of the replay that holds each frame, int64 (batch, time + 1); `Replay.refresh` takes these rows.
    """

    frames: Tensor
    deter: Tensor
    actions: Tensor
    rewards: Tensor
    continues: Tensor
    labels: Tensor
    rows: Tensor

    @property
    def within(self) -> Tensor:
        """1 for transitions of the episode that the sequence begins in, 0 after its terminal state, (batch, time)."""
        before = torch.cat([torch.ones_like(self.continues[:, :1]), self.continues[:, :-1]], 1)
        return before.cumprod(1)


class Replay:
    """A ring buffer of rows for each environment, allocated once, and a lane of recorded rows that are kept for good.

    The rows of a lane are numbered from 0 as they are added; row n lies at place n % size of the lane.

    Attributes:
        lane_size: Rows of the lane of an environment.
        num_lanes: Lanes of environments, and the lane of recorded rows, which is the last one, if there is one.
        sizes: Rows of each lane, int64 (lane,).
        starts: Place of each lane's first row among the rows of all lanes, int64 (lane,).
        num_recorded: Rows of the lane of recorded rows; 0 without one.
        first: Number of the oldest row that each lane holds, int64 (lane,).
        written: Number of rows that were added to each lane, int64 (lane,).

    Args:
        capacity: Number of collected rows, split evenly over the environments.
        action_dim: Size of the action.
        deter_dim: Size of the stored belief.
        num_lanes: Number of environments, each with a lane of its own.
        device: Device of the rows and of the batches.
        num_labels: Number of quantities that the simulator reports with each frame.
        frame_shape: Shape of a frame.
        num_recorded: Rows of episodes that were recorded before the run.

    Raises:
        UserError: The rows do not fit into nine tenths of the free memory.
    """

    def __init__(
        self,
        capacity: int,
        action_dim: int,
        deter_dim: int,
        num_lanes: int,
        device: torch.device,
        num_labels: int = 0,
        frame_shape: tuple[int, ...] = FRAME_SHAPE,
        num_recorded: int = 0,
    ) -> None:
        self.lane_size = -(-capacity // num_lanes)
        self.num_recorded, self.device = num_recorded, device
        self.sizes = np.array([self.lane_size] * num_lanes + [num_recorded] * (num_recorded > 0), dtype=np.int64)
        self.starts = self.sizes.cumsum() - self.sizes
        self.num_lanes, total = len(self.sizes), int(self.sizes.sum())
        self.num_bytes = count_replay_bytes(total, action_dim, deter_dim, num_labels, math.prod(frame_shape))
        check_memory(self.num_bytes, device)
        self.frames = torch.zeros(total, *frame_shape, dtype=torch.uint8, device=device)
        self.deter = torch.zeros(total, deter_dim, dtype=torch.float16, device=device)
        self.actions = torch.zeros(total, action_dim, device=device)
        self.rewards = torch.zeros(total, device=device)
        self.continues = torch.ones(total, device=device)
        self.labels = torch.zeros(total, num_labels, device=device)
        self.episode = np.full(total, -1, dtype=np.int64)
        self.is_end = np.zeros(total, dtype=bool)  # rows whose action led to a terminal state
        self.first = np.zeros(self.num_lanes, dtype=np.int64)
        self.written = np.zeros(self.num_lanes, dtype=np.int64)

    def __len__(self) -> int:
        """Number of rows held."""
        return int((self.written - self.first).sum())

    @property
    def has_recorded_end(self) -> bool:
        """Whether a recorded episode ended in a terminal state."""
        return self.num_recorded > 0 and bool(self.is_end[self.starts[-1] :].any())

    def add(self, lane: int, rows: Rows) -> None:
        """Appends consecutive rows to a lane; a full lane overwrites its oldest rows."""
        count = len(rows.frames)
        newest = np.arange(count)[-int(self.sizes[lane]) :]
        places = self.places(lane, self.written[lane] + newest)
        has_rows = self.written[lane] > self.first[lane]
        previous = self.episode[self.places(lane, self.written[lane] - 1)] if has_rows else -1
        self.episode[places] = previous + np.cumsum(rows.is_first)[newest]
        self.is_end[places] = rows.continues[newest] == 0.0
        index = torch.as_tensor(places, device=self.device)
        for name in ("frames", *COLUMNS):
            store = getattr(self, name)
            store[index] = torch.as_tensor(getattr(rows, name)[newest], device=self.device).to(store.dtype)
        self.written[lane] += count
        self.first[lane] = max(self.first[lane], self.written[lane] - self.sizes[lane])

    def draw(self, batch_size: int, sequence_length: int, rng: np.random.Generator) -> Tensor:
        """Rows of uniformly drawn sequences, (batch, time + 1).

        A sequence lies within one episode, or continues in the next episode after a terminal state. Without the second
        kind only one sequence would contain the transition to a terminal state, while `sequence_length` sequences
        contain any other transition.

        Args:
            batch_size: Number of sequences.
            sequence_length: Decisions in each sequence; a sequence has one row more.
            rng: Random stream of the draw.

        Raises:
            UserError: No episode is long enough.
        """
        lanes, starts = self._draw_starts(batch_size, sequence_length, rng)
        steps = np.arange(sequence_length + 1)
        return torch.as_tensor(self.places(lanes[:, None], starts[:, None] + steps), device=self.device)

    def gather(self, rows: Tensor) -> Batch:
        """The sequences at rows (batch, time + 1); no value is read back from the device."""
        acted = rows[:, :-1]
        return Batch(
            frames=self.frames[rows],
            deter=self.deter[rows[:, 0]].float(),
            actions=self.actions[acted],
            rewards=self.rewards[acted],
            continues=self.continues[acted],
            labels=self.labels[rows],
            rows=rows,
        )

    def refresh(self, rows: Tensor, deter: Tensor, chosen: Tensor) -> None:
        """Replaces the stored beliefs of some rows by newer beliefs.

        Args:
            rows: Indices in the replay, (batch, time). A row that occurs more than once gets its last chosen belief.
            deter: The newer beliefs, (batch, time, deter).
            chosen: The beliefs to store, bool (batch, time).
        """
        index = rows.flatten().to(self.device)
        is_chosen = chosen.to(self.device).flatten()
        # Parallel writes to one row have no order, so every occurrence of a row writes the row's last chosen belief.
        in_order, order = (2 * index + is_chosen).sort(stable=True)
        last = order[torch.searchsorted(in_order, 2 * index + 1, right=True) - 1]
        newer = deter.flatten(0, 1).to(self.deter)[last]
        self.deter[index] = torch.where(is_chosen[last, None], newer, self.deter[index])

    def held_rows(self, lane: int) -> Tensor:
        """Rows of this replay that hold a lane's rows, from the oldest to the newest, int64 (n,)."""
        numbers = np.arange(self.first[lane], self.written[lane])
        return torch.as_tensor(self.places(lane, numbers), device=self.device)

    def places(self, lanes: Any, numbers: Any) -> Any:
        """Rows of this replay that hold the rows with some numbers in their lanes.

        Args:
            lanes: A lane, or lanes that broadcast against the numbers.
            numbers: Numbers of rows, int64.
        """
        return numbers % self.sizes[lanes] + self.starts[lanes]

    def _draw_starts(self, count: int, length: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Lane and first position of `count` sequences of `length` decisions, (count,) each."""
        held, oldest = self.written - self.first, self.first
        lanes, starts = np.empty(0, np.int64), np.empty(0, np.int64)
        too_short = f"no episode in replay has sequence_length ({length}) decisions"
        if self.sizes.max() <= length:
            raise UserError(f"{too_short}: raise --replay.capacity")
        if held.max() <= length:
            raise UserError(
                f"{too_short}, of {held.max()} in each environment: raise --collection.prefill_decisions or --frames"
            )
        for _ in range(SAMPLING_ROUNDS):
            lane = rng.choice(self.num_lanes, size=2 * count, p=held / held.sum())
            offset = rng.integers(0, held[lane])
            start, num_following = oldest[lane] + offset, held[lane] - offset
            steps = self.places(lane[:, None], start[:, None] + np.arange(length + 1))
            is_same = self.episode[steps] == self.episode[steps[:, :1]]
            last = is_same.cumprod(1).sum(1) - 1  # steps until the last row of the episode, at most the length
            is_terminal = self.is_end[steps[np.arange(len(last)), last - 1]] & (last > 0)
            keep = (last < num_following) & ((last == length) | is_terminal)
            lanes, starts = np.concatenate([lanes, lane[keep]]), np.concatenate([starts, start[keep]])
            if len(starts) >= count:
                return lanes[:count], starts[:count]
        raise UserError(f"{too_short}: lower --learning.sequence_length")


def write_saved(value: Any, path: Path) -> None:
    """Writes tensors and plain values, in lists and dictionaries, to a file that `read_saved` reads.

    Raises:
        OSError: The file cannot be written.
    """
    buffer = io.BytesIO()  # where torch writes to a full disk itself, its error does not say so
    torch.save(value, buffer)
    write_synced(path, buffer.getbuffer())


def read_saved(path: Path, keys: Sequence[str] | Mapping[str, Any] = ()) -> Any:
    """The object that `write_saved` wrote to a file, with its tensors on the CPU.

    Args:
        path: The file.
        keys: If any are given, the object must be a dictionary with these keys, and the values have the types that a
            mapping gives; see `fits`.

    Raises:
        DamageError: The file is damaged, lacks one of the keys, or has a value of another type.
    """
    try:
        saved = torch.load(path, map_location="cpu", weights_only=True)
    except UnpicklingError:  # torch's message would advise to run what the file says
        raise DamageError(f"{path} is damaged: it holds more than tensors and plain values") from None
    except MemoryError:
        raise
    except Exception as error:  # damaged bytes make the unpickler raise errors of many types
        reason = (str(error).splitlines() or ["it ends too early"])[0][:120]
        raise DamageError(f"{path} is damaged: {reason}") from None
    if keys and not (isinstance(saved, dict) and set(keys) <= set(saved)):
        raise DamageError(f"{path} is damaged: it does not hold {', '.join(keys)}")
    for name, kind in keys.items() if isinstance(keys, Mapping) else ():
        if not fits(saved[name], kind):
            raise DamageError(f"{path} is damaged: {name} has another form")
    return saved
