"""What ends in a terminal state is drawn to its end, and no further is learned from."""

import numpy as np
import pytest
import torch

from latentplan.replay.buffer import Batch
from tests.replay.replay_clock import Clock, filled, make_replay, sample, told


def test_terminal_states_are_drawn_as_often_as_they_come():
    replay, rng = make_replay(capacity=4000), np.random.default_rng(0)
    lengths = rng.geometric(0.1, 200)
    rows = Clock(0, lengths).rows()
    transitions = np.flatnonzero(rows.actions[:, 0] > 0.0)
    last = transitions[~np.isin(transitions + 1, transitions)]
    rows.continues[last] = 0.0
    replay.add(0, rows)
    drawn = replay.gather(replay.draw(4000, 16, rng))
    time, weights = told(drawn)[0], drawn.within
    assert (time.diff(dim=1)[weights == 1.0] == 1.0).all()
    share = ((1.0 - drawn.continues) * weights).sum() / weights.sum()
    assert share == pytest.approx(0.1, abs=0.02)  # what an episode of these has of ending at any step


def test_what_follows_a_terminal_state_is_not_refreshed_nor_within():
    continues = torch.tensor([[1.0, 0.0, 1.0, 0.0], [1.0, 1.0, 1.0, 1.0], [0.0, 1.0, 1.0, 1.0]])
    batch = Batch(*[torch.empty(0)] * 4, continues, *[torch.empty(0)] * 2)
    assert batch.within.tolist() == [[1, 1, 0, 0], [1, 1, 1, 1], [1, 0, 0, 0]]


def test_an_end_by_the_clock_is_not_reached_beyond(tmp_path):
    replay = filled(lengths=(7, 4, 9))
    assert not replay.is_end.any() and (sample(replay, length=5).within == 1.0).all()
    rows = Clock(0, (7, 4, 9)).rows()
    rows.continues[11] = 0.0  # the second ends in a terminal state
    ended = make_replay()
    ended.add(0, rows)
    starts = {int(row) for row in ended.draw(200, 5, np.random.default_rng(0))[:, 0]}
    assert starts == {0, 1, 2, 8, 9, 10, 11, 13, 14, 15, 16, 17}
    ended.save(tmp_path)
    again = make_replay()
    again.load(tmp_path)
    assert np.array_equal(again.is_end, ended.is_end)
