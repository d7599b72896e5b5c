"""The rows of some processes are dealt to another number: nothing is lost, doubled or mixed, and shares are even."""

import numpy as np
import pytest
import torch

from latentplan.config import UserError
from latentplan.config.commit import Saves
from latentplan.replay.buffer import Replay, Rows
from latentplan.replay.dealing import DealtRows, count_ranks
from latentplan.replay.disk import ReplayFiles

LENGTHS = [7, 5, 9, 8, 6, 9]
CPU, FRAME = torch.device("cpu"), (4, 4, 3)


def make_replay(capacity, lanes=1, recorded=0):
    return Replay(capacity, 1, 2, lanes, CPU, frame_shape=FRAME, num_recorded=recorded)


def make_rows(first, lengths):
    """Episodes of some lengths whose rows have the numbers from `first` on; frames and actions show the numbers."""
    numbers = np.arange(first, first + sum(lengths))
    starts = np.cumsum([0, *lengths[:-1]])
    return Rows(
        frames=np.broadcast_to((numbers % 251)[:, None, None, None], (len(numbers), *FRAME)).astype(np.uint8),
        deter=np.stack([numbers, numbers], 1).astype(np.float32),
        actions=numbers[:, None].astype(np.float32),
        rewards=-numbers.astype(np.float32),
        continues=1.0 - np.isin(np.arange(len(numbers)), starts + np.array(lengths) - 2).astype(np.float32),
        is_first=np.isin(np.arange(len(numbers)), starts),
        labels=np.zeros((len(numbers), 0), np.float32),
    )


def save_all(saves, replays):
    """Saves the replays of several processes in one save."""

    def write(part):
        extents = {}
        for rank, replay in enumerate(replays):
            extents |= ReplayFiles(saves.folder, replay, rank).write(part)
        return extents

    return saves.commit(write, {})


def deal(save, size, capacity=200, lanes=1, recorded=False):
    """The replays of the processes among which the rows of a save are dealt."""
    replays = []
    for rank in range(size):
        dealt = DealtRows(save, rank, size)
        replays.append(make_replay(capacity, lanes, dealt.counts.recorded_rows))
        dealt.fill(replays[-1])
        assert dealt.counts.num_lanes == lanes
    return replays


def held(replay, lane=0):
    """Numbers of the rows of a lane, by their actions, from the oldest to the newest."""
    return replay.actions[replay.held_rows(lane), 0].int().tolist()


def episodes(replay, lane=0):
    """Numbers of the rows of each episode of a lane."""
    index = replay.held_rows(lane).numpy()
    edges = np.flatnonzero(np.diff(replay.episode[index])) + 1
    return [part.tolist() for part in np.split(np.array(held(replay, lane)), edges)]


@pytest.mark.parametrize(("before", "after"), [(1, 2), (2, 1), (3, 2), (2, 4)])
def test_dealt_rows_are_the_saved_rows_in_whole_episodes(tmp_path, before, after):
    saved = [make_replay(100) for _ in range(before)]
    whole = []
    for rank, replay in enumerate(saved):
        replay.add(0, make_rows(100 * rank, LENGTHS))
        ends = 100 * rank + np.cumsum(LENGTHS)
        whole += [[*range(end - length, end)] for length, end in zip(LENGTHS, ends.tolist(), strict=True)]
    save = save_all(Saves(tmp_path, "replay", 1), saved)
    assert count_ranks(save) == before
    found = deal(save, after)
    assert sorted(number for replay in found for number in held(replay)) == sorted(sum(whole, []))
    assert sorted(part for replay in found for part in episodes(replay)) == sorted(whole)
    assert max(map(len, found)) - min(map(len, found)) <= 9  # an episode
    for replay in found:
        index = replay.held_rows(0)
        numbers = replay.actions[index, 0]
        assert torch.equal(replay.frames[index, 0, 0, 0], (numbers % 251).to(torch.uint8))
        assert torch.equal(replay.rewards[index], -numbers) and torch.equal(replay.deter[index, 1], numbers.half())
        assert replay.is_end[index.numpy()].sum() == len(episodes(replay))


def test_an_episode_that_is_longer_than_a_share_is_cut(tmp_path):
    replay = make_replay(100)
    replay.add(0, make_rows(0, [30]))
    found = deal(save_all(Saves(tmp_path, "replay", 1), [replay]), 3)
    assert [held(each) for each in found] == [[*range(10)], [*range(10, 20)], [*range(20, 30)]]


def test_rows_of_a_ring_that_has_turned_are_dealt_and_the_newest_stay(tmp_path):
    saved = [make_replay(20), make_replay(20)]
    for rank, replay in enumerate(saved):
        for part in range(3):
            replay.add(0, make_rows(100 * rank + 9 * part, [9]))
    save = save_all(Saves(tmp_path, "replay", 1), saved)
    (found,) = deal(save, 1, capacity=200)
    assert sorted(held(found)) == [*range(7, 27), *range(107, 127)]
    (found,) = deal(save, 1, capacity=20)
    assert held(found)[-18:] == [*range(18, 27), *range(118, 127)]


def test_lanes_and_recorded_rows_stay_apart(tmp_path):
    saved = []
    for rank in range(2):
        saved.append(make_replay(40, lanes=2, recorded=12))
        for lane in range(3):
            saved[-1].add(lane, make_rows(100 * rank + 1000 * lane, [6, 6]))
    (found,) = deal(save_all(Saves(tmp_path, "replay", 1), saved), 1, lanes=2)
    assert found.num_recorded == 24
    for lane in range(3):
        assert {number // 1000 for number in held(found, lane)} == {lane} and len(held(found, lane)) == 24


@pytest.mark.parametrize("size", [1, 3])
def test_a_save_of_dealt_rows_leaves_the_save_before_whole(tmp_path, size):
    saved = [make_replay(100), make_replay(100)]
    for rank, replay in enumerate(saved):
        replay.add(0, make_rows(100 * rank, [8, 8]))
    saves = Saves(tmp_path, "replay", 1)
    before = save_all(saves, saved)
    after = save_all(saves, deal(before, size))
    saves.verify(before.folder)
    rows = [number for replay in deal(after, 2) for number in held(replay)]
    assert sorted(rows) == [*range(16), *range(100, 116)]


def test_dealt_rows_of_other_sizes_are_refused(tmp_path):
    replay = make_replay(100)
    replay.add(0, make_rows(0, [30]))
    save = save_all(Saves(tmp_path, "replay", 1), [replay])
    with pytest.raises(UserError, match=r"\(environments, action, deter, labels\)"):
        DealtRows(save, 0, 2).fill(Replay(100, 3, 2, 1, CPU, frame_shape=FRAME))
