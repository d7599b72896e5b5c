"""Recorded episodes become rows of replays: each learning process gets its own, and long ones to draw from."""

from types import SimpleNamespace

import numpy as np
import pytest

from latentplan.config import UserError
from latentplan.replay.buffer import Replay
from latentplan.training.demonstrations.seeding import count_rows, seed_replay
from tests.replay.numbered_rows import CPU, NumberedRows


def recording(*lengths):
    """A recording of episodes with some numbers of decisions; the frames of episode i hold i."""
    rows = NumberedRows(0, lengths)
    starts = np.cumsum([0, *(length + 1 for length in lengths)])
    return SimpleNamespace(lengths=list(lengths), read=lambda i: rows.rows(starts[i], starts[i + 1]))


def seed(recordings, rank, size, sequence_length=16):
    """The replay of one process, and its episodes in order."""
    num_rows = count_rows(recordings, sequence_length, rank, size)
    replay = Replay(10, action_dim=1, deter_dim=2, num_lanes=1, device=CPU, num_labels=2, num_recorded=num_rows)
    seed_replay(replay, recordings, rank, size)
    lane = replay.held_rows(replay.num_lanes - 1)
    firsts = lane[np.flatnonzero(replay.labels[lane, 0].numpy() == 0.25)]
    return replay, replay.frames[firsts, 0, 0, 1].tolist()


@pytest.mark.parametrize("lengths", [(20, 3, 20, 3), (3, 3, 20, 20), (20, 3, 3, 16, 3)])
def test_every_process_gets_an_episode_that_it_can_draw_from(lengths):
    recordings, dealt = [recording(*lengths)], []
    for rank in range(2):
        replay, episodes = seed(recordings, rank, 2)
        assert replay.draw(4, 16, np.random.default_rng(0)).shape == (4, 17)
        dealt += episodes
    assert sorted(dealt) == list(range(len(lengths)))


def test_one_process_gets_all_episodes_in_the_order_of_the_recording():
    assert seed([recording(3, 20, 0, 5, 20)], 0, 1)[1] == [0, 1, 3, 4]


def test_fewer_long_episodes_than_processes_are_refused():
    with pytest.raises(UserError, match=r"hold 1 episodes of at least learning\.sequence_length \(16\) decisions"):
        count_rows([recording(20, 3, 3)], 16, 1, 2)
    assert count_rows([], 16, 1, 2) == 0  # without recordings
