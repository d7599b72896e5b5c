"""Recorded rows have a lane of their own, which is never overwritten."""

import pytest
import torch

from latentplan.config.commit import Saves
from latentplan.replay.buffer import Replay
from latentplan.replay.disk import FORMAT, ReplayFiles, count_saved
from tests.replay.numbered_rows import CPU, NumberedRows, assert_aligned, frame_values, sample
from tests.replay.test_disk import assert_same

RECORDED = (7, 4)


def make_replay(capacity=12, lanes=2, recorded=RECORDED):
    num_recorded = sum(length + 1 for length in recorded)
    return Replay(capacity, 1, 2, lanes, CPU, num_labels=2, num_recorded=num_recorded)


def fill(replay, lengths=(7, 4, 9, 6), lanes=2, recorded=RECORDED):
    replay.add(replay.num_lanes - 1, NumberedRows(99, recorded).rows())
    for lane in range(lanes):
        replay.add(lane, NumberedRows(lane, lengths).rows())
    return replay


def test_recorded_rows_stay_when_the_lanes_of_environments_are_overwritten():
    replay = fill(make_replay())
    assert replay.frames[-13:, 0, 0, 2].eq(99).all()
    assert [len(replay.held_rows(lane)) for lane in range(3)] == [6, 6, 13]
    assert len(replay) == 25


@pytest.mark.parametrize("length", [1, 3, 5])
def test_draw_takes_aligned_sequences_of_collected_and_recorded_rows(length):
    batch = sample(fill(make_replay(capacity=40)), 500, length)
    assert_aligned(batch)
    assert set(frame_values(batch)[2].flatten().tolist()) == {0.0, 1.0, 99.0}


def test_draw_takes_recorded_rows_alone_when_nothing_was_collected():
    replay = make_replay(capacity=2)
    replay.add(2, NumberedRows(99, RECORDED).rows())
    batch = sample(replay, 200, length=3)
    assert_aligned(batch)
    starts = {tuple(start) for start in torch.stack(frame_values(batch)[:2], -1)[:, 0].tolist()}
    assert starts == {(start, 0.0) for start in range(5)} | {(start, 1.0) for start in range(2)}


def test_replay_without_recorded_rows_has_no_lane_for_them():
    assert make_replay(recorded=()).num_lanes == 2


@pytest.mark.parametrize("capacity", [12, 60])
def test_read_restores_recorded_rows(capacity, tmp_path):
    replay, saves = fill(make_replay(capacity)), Saves(tmp_path, "replay", FORMAT)
    save = saves.commit(ReplayFiles(tmp_path, replay).write, {})
    counts = count_saved(save)
    assert counts == (2, min(capacity // 2, 30), 13)
    loaded = Replay(capacity, 1, 2, counts.num_lanes, CPU, num_labels=2, num_recorded=counts.recorded_rows)
    ReplayFiles(tmp_path, loaded).read(saves.newest()[0])
    assert_same(replay, loaded)
    assert loaded.frames[-13:, 0, 0, 2].eq(99).all()


@pytest.mark.parametrize("lanes", [(True, False), (False, True), (False, False)])
def test_recorded_end_is_that_of_the_recorded_lane(lanes):
    replay, rows = make_replay(capacity=40), NumberedRows(0, RECORDED).rows()
    for lane, has_end in zip((0, 2), lanes, strict=True):
        rows.continues[-2] = 0.0 if has_end else 1.0
        replay.add(lane, rows)
    assert replay.has_recorded_end == lanes[1]
