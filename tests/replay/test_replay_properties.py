"""Laws of the replay, for any order of episodes, chunks and lanes."""

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from latentplan.config import UserError
from tests.replay.numbered_rows import NumberedRows, assert_aligned, make_replay, sample

lengths = st.lists(st.integers(1, 9), min_size=1, max_size=6)


@st.composite
def filled(draw):
    """A replay, the numbered rows of its lanes, and how many rows of each lane were added."""
    lanes = draw(st.integers(1, 3))
    replay = make_replay(draw(st.integers(4, 60)), lanes)
    numbered = [NumberedRows(lane, draw(lengths)) for lane in range(lanes)]
    added = [0] * lanes
    for _ in range(draw(st.integers(1, 8))):
        lane, count = draw(st.integers(0, lanes - 1)), draw(st.integers(0, 12))
        rows = numbered[lane].rows(added[lane], added[lane] + count)
        if len(rows.frames):
            replay.add(lane, rows)
            added[lane] += len(rows.frames)
    return replay, numbered, added


@given(filled())
def test_lanes_hold_their_newest_rows(case):
    replay, numbered, added = case
    assert len(replay) == sum(min(count, replay.lane_size) for count in added)
    for lane, count in enumerate(added):
        held = range(max(0, count - replay.lane_size), count)
        for position in held:
            row = lane * replay.lane_size + position % replay.lane_size
            number, episode, time, _ = numbered[lane].entries[position]
            assert replay.frames[row, 0, 0].tolist() == [time, episode, number]


@given(filled(), st.integers(1, 6), st.integers(0, 2**20))
def test_sequences_are_aligned_and_stay_within_an_episode(case, length, seed):
    replay, _, added = case
    if not any(added):
        return
    try:
        batch = sample(replay, batch_size=8, length=length, seed=seed)
    except UserError as error:
        assert "no episode in replay" in str(error)
        return
    assert batch.frames.shape == (8, length + 1, 64, 64, 3) and batch.frames.dtype == torch.uint8
    assert batch.deter.shape == (8, 2) and batch.deter.dtype == torch.float32
    assert_aligned(batch)
    again = sample(replay, batch_size=8, length=length, seed=seed)
    assert torch.equal(batch.rows, again.rows)


@given(filled(), st.integers(0, 2**20))
def test_refresh_changes_the_chosen_beliefs_alone(case, seed):
    replay, _, added = case
    if not any(added):
        return
    rng = np.random.default_rng(seed)
    rows = torch.as_tensor(rng.integers(0, len(replay.deter), (3, 4)))
    chosen = torch.as_tensor(rng.random((3, 4)) < 0.5)
    newer = torch.as_tensor(rng.integers(-100, 100, (3, 4, 2)), dtype=torch.float32)
    before = replay.deter.clone()
    replay.refresh(rows, newer, chosen)
    for row in range(len(before)):
        places = [(i, j) for i in range(3) for j in range(4) if rows[i, j] == row and chosen[i, j]]
        expected = newer[places[-1]] if places else before[row].float()
        assert torch.equal(replay.deter[row].float(), expected)
