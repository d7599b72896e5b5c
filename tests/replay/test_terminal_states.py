"""Terminal states: drawn sequences reach beyond them, but not beyond time limits."""

import numpy as np
import pytest
import torch

from latentplan.config.commit import Saves
from latentplan.replay.buffer import Batch
from latentplan.replay.disk import FORMAT, ReplayFiles, save_replay
from tests.replay.numbered_rows import NumberedRows, make_filled_replay, make_replay, sample


def make_batch(continues):
    """Makes a batch in which all fields but `continues` are empty."""
    return Batch(**{**dict.fromkeys(Batch._fields, torch.empty(0)), "continues": continues})


def test_draw_reaches_terminal_states_at_their_true_rate():
    replay, rng = make_replay(capacity=4000), np.random.default_rng(0)
    lengths = rng.geometric(0.1, 200)
    rows = NumberedRows(0, lengths).rows()
    transitions = np.flatnonzero(rows.actions[:, 0] > 0.0)
    last = transitions[~np.isin(transitions + 1, transitions)]
    rows.continues[last] = 0.0
    replay.add(0, rows)
    drawn = replay.draw(4000, 16, rng)
    time = replay.frames[:, 0, 0, 0].float()[drawn]
    continues = replay.continues[drawn[:, :-1]]
    weights = make_batch(continues).within
    assert (time.diff(dim=1)[weights == 1.0] == 1.0).all()
    share = ((1.0 - continues) * weights).sum() / weights.sum()
    assert share == pytest.approx(0.1, abs=0.02)  # the lengths are geometric: each step ends with probability 0.1


def test_within_is_0_after_a_terminal_state():
    continues = torch.tensor([[1.0, 0.0, 1.0, 0.0], [1.0, 1.0, 1.0, 1.0], [0.0, 1.0, 1.0, 1.0]])
    assert make_batch(continues).within.tolist() == [[1, 1, 0, 0], [1, 1, 1, 1], [1, 0, 0, 0]]


def test_draw_reaches_beyond_terminal_states_but_not_beyond_time_limits(tmp_path):
    replay = make_filled_replay(lengths=(7, 4, 9))
    assert not replay.is_end.any() and (sample(replay, length=5).within == 1.0).all()
    rows = NumberedRows(0, (7, 4, 9)).rows()
    rows.continues[11] = 0.0  # the second episode ends in a terminal state
    ended = make_replay()
    ended.add(0, rows)
    starts = {int(row) for row in ended.draw(200, 5, np.random.default_rng(0))[:, 0]}
    assert starts == {0, 1, 2, 8, 9, 10, 11, 13, 14, 15, 16, 17}
    save_replay(ended, tmp_path, {})
    again = make_replay()
    ReplayFiles(tmp_path, again).read(Saves(tmp_path, "replay", FORMAT).newest()[0])
    assert np.array_equal(again.is_end, ended.is_end)
