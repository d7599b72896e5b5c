"""Rows whose values encode their lane, episode and time, for tests of the replay."""

import numpy as np
import torch

from latentplan.replay.buffer import Replay, Rows

CPU = torch.device("cpu")


class NumberedRows:
    """Rows of one lane with episodes of given lengths.

    Each frame is filled with its time, episode and lane. action[t] leads from t to t + 1, so it is (t + 0.5) / 256, in
    [-1, 1]. The reward that arrives with frame t + 1 is t + 1.
    """

    def __init__(self, lane, lengths):
        self.entries = [
            (lane, episode, time, time == length)
            for episode, length in enumerate(lengths)
            for time in range(length + 1)
        ]

    def rows(self, start=0, stop=None):
        entries = self.entries[start:stop]
        frames = np.zeros((len(entries), 64, 64, 3), np.uint8)
        for frame, (lane, episode, time, _) in zip(frames, entries, strict=True):
            frame[:] = (time, episode, lane)
        time = np.array([entry[2] for entry in entries], np.float32)
        last = np.array([entry[3] for entry in entries], bool)
        return Rows(
            frames=frames,
            deter=np.stack([time, time + 1000.0], -1),
            actions=np.where(last, 0.0, (time + 0.5) / 256)[:, None].astype(np.float32),
            rewards=np.where(last, 0.0, time + 1.0).astype(np.float32),
            continues=np.ones(len(entries), np.float32),
            is_first=time == 0.0,
            labels=np.stack([time + 0.25, -time], -1),
        )


def make_replay(capacity=60, lanes=1):
    return Replay(capacity, action_dim=1, deter_dim=2, num_lanes=lanes, device=CPU, num_labels=2)


def make_filled_replay(capacity=60, lanes=1, lengths=(7, 4, 9), chunk=5):
    replay = make_replay(capacity, lanes)
    for lane in range(lanes):
        numbered = NumberedRows(lane, lengths)
        for start in range(0, len(numbered.entries), chunk):
            replay.add(lane, numbered.rows(start, start + chunk))
    return replay


def sample(replay, batch_size=64, length=3, seed=0):
    return replay.gather(replay.draw(batch_size, length, np.random.default_rng(seed)))


def frame_values(batch):
    """Time, episode and lane, read from each frame, (batch, time + 1) each."""
    assert (batch.frames == batch.frames[:, :, :1, :1]).all()
    return batch.frames[:, :, 0, 0].float().unbind(-1)


def assert_aligned(batch):
    """Each sequence lies within one episode, and what comes with a frame belongs to it."""
    time, episode, lane = frame_values(batch)
    assert (time.diff(dim=1) == 1.0).all()
    assert (episode == episode[:, :1]).all() and (lane == lane[:, :1]).all()
    assert torch.allclose(batch.actions[..., 0], (time[:, :-1] + 0.5) / 256)
    assert torch.equal(batch.rewards, time[:, 1:])
    assert torch.equal(batch.deter[:, 0], time[:, 0])
