"""The replay on disk: what was saved is restored, and a save writes new frames only."""

import os
import resource

import numpy as np
import pytest
import torch

from latentplan.config import UserError
from latentplan.config.commit import DamageError, Saves
from latentplan.replay.buffer import Replay, write_saved
from latentplan.replay.disk import FORMAT, ReplayFiles
from tests.replay.numbered_rows import CPU, NumberedRows, assert_aligned, make_filled_replay, make_replay, sample
from tests.replay.test_buffer import RINGS


class Disk:
    """A replay with its saves in a folder."""

    def __init__(self, folder, replay):
        self.replay, self.saves = replay, Saves(folder, "replay", FORMAT)
        self.files = ReplayFiles(folder, replay)

    def save(self):
        return self.saves.commit(self.files.write, {})

    def load(self):
        self.files.read(self.saves.newest()[0])
        return self


def assert_same(left, right):
    assert len(left) == len(right)
    for seed in range(3):
        pairs = zip(sample(left, seed=seed), sample(right, seed=seed), strict=True)
        assert all(torch.equal(first, second) for first, second in list(pairs)[:-1])  # rows may lie elsewhere


@pytest.mark.parametrize("ring", RINGS)
def test_read_restores_a_saved_replay(ring, tmp_path):
    replay = make_filled_replay(**ring)
    Disk(tmp_path, replay).save()
    loaded = Disk(tmp_path, make_replay(ring.get("capacity", 60), ring.get("lanes", 1))).load().replay
    assert_same(replay, loaded)
    for name in ("episode", "is_end", "first", "written"):
        assert np.array_equal(getattr(replay, name), getattr(loaded, name)), name


@pytest.mark.parametrize("capacity", [60, 12])
def test_save_in_parts_restores_as_at_once(capacity, tmp_path):
    numbered = NumberedRows(0, (7, 4, 9))
    disk = Disk(tmp_path, make_replay(capacity))
    for start in range(0, len(numbered.entries), 4):
        disk.replay.add(0, numbered.rows(start, start + 4))
        disk.save()
        if start == 8:  # go on from disk halfway
            disk = Disk(tmp_path, make_replay(capacity)).load()
    assert_same(disk.replay, Disk(tmp_path, make_replay(capacity)).load().replay)
    assert_same(make_filled_replay(capacity=capacity), disk.replay)


def test_save_appends_new_frames_only(tmp_path):
    disk, numbered = Disk(tmp_path, make_replay()), NumberedRows(0, (7, 4, 9))
    disk.replay.add(0, numbered.rows(0, 8))
    disk.save()
    disk.replay.frames[:8] = 99  # frames do not change; if they did, a save would not look at them again
    disk.replay.add(0, numbered.rows(8, 13))
    disk.save()
    (path,) = (tmp_path / "logs").iterdir()
    stored = np.fromfile(path, np.uint8).reshape(-1, 64, 64, 3)
    assert len(stored) == 13
    assert (stored[:8, 0, 0, 1] == 0).all() and (stored[8:, 0, 0, 1] == 1).all()


def test_save_removes_files_of_frames_that_the_ring_has_overwritten(tmp_path):
    disk, numbered = Disk(tmp_path, make_replay(12)), NumberedRows(0, (199,))
    disk.files._logs[0].rows_per_file = 10
    for start in range(0, 200, 8):
        disk.replay.add(0, numbered.rows(start, start + 8))
        disk.save()
    names = sorted(int(path.name.partition("-")[2]) for path in (tmp_path / "logs").iterdir())
    assert names[0] >= 200 - 12 - 8 - 10 and len(names) <= 4
    assert_same(disk.replay, Disk(tmp_path, make_replay(12)).load().replay)


def test_save_begins_a_new_file_after_rows_that_were_overwritten_before_they_were_saved(tmp_path):
    disk, numbered = Disk(tmp_path, make_replay(12)), NumberedRows(0, (99,))
    disk.replay.add(0, numbered.rows(0, 8))
    disk.save()
    disk.replay.add(0, numbered.rows(8, 60))
    disk.save()
    assert_same(disk.replay, Disk(tmp_path, make_replay(12)).load().replay)


def test_save_that_fails_leaves_the_save_before(tmp_path, monkeypatch):
    disk, numbered = Disk(tmp_path, make_replay()), NumberedRows(0, (7, 4, 9))
    disk.replay.add(0, numbered.rows(0, 8))
    disk.save()
    size = sum(path.stat().st_size for path in tmp_path.rglob("*") if path.is_file())
    disk.replay.add(0, numbered.rows(8, 13))

    def full(*_):
        raise OSError(28, "No space left on device")

    for target, name in ((os, "fsync"), (torch, "save")):
        with monkeypatch.context() as patch:
            patch.setattr(target, name, full)
            with pytest.raises(OSError, match="No space left"):
                disk.save()
        assert len(Disk(tmp_path, make_replay()).load().replay) == 8
        assert not list(tmp_path.glob("*.part"))
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(OSError, match="No space left"):
            disk.save()
    assert sum(path.stat().st_size for path in tmp_path.rglob("*") if path.is_file()) <= size + 5 * 12288
    disk.save()
    assert_same(disk.replay, Disk(tmp_path, make_replay()).load().replay)


@pytest.mark.parametrize("damage", [os.unlink, lambda path: os.truncate(path, 10)])
@pytest.mark.parametrize("capacity", [60, 12])
def test_save_writes_frames_again_whose_log_was_changed(tmp_path, damage, capacity):
    disk, numbered = Disk(tmp_path, make_replay(capacity)), NumberedRows(0, (99,))
    disk.files._logs[0].rows_per_file = 10
    for start in range(0, 24, 8):
        disk.replay.add(0, numbered.rows(start, start + 8))
        disk.save()
    path = sorted((tmp_path / "logs").iterdir())[-2]
    damage(path)
    disk.replay.add(0, numbered.rows(24, 32))
    with pytest.warns(RuntimeWarning, match=f"{path.name} was changed by another program"):
        disk.save()
    assert_same(disk.replay, Disk(tmp_path, make_replay(capacity)).load().replay)
    disk.replay.add(0, numbered.rows(32, 40))
    disk.save()
    assert_same(disk.replay, Disk(tmp_path, make_replay(capacity)).load().replay)


@pytest.mark.parametrize(("before", "after"), [(60, 100), (12, 60), (60, 14), (12, 8)])
def test_read_keeps_the_newest_rows_in_another_capacity(before, after, tmp_path):
    replay = make_filled_replay(capacity=before)
    Disk(tmp_path, replay).save()
    disk = Disk(tmp_path, make_replay(after)).load()
    loaded = disk.replay
    assert len(loaded) == min(len(replay), after)
    assert_aligned(sample(loaded))
    newest = [entry[2::-1] for entry in NumberedRows(0, (7, 4, 9)).entries[-len(loaded) :]]
    held = loaded.frames[torch.from_numpy(loaded.episode >= 0)]
    assert sorted(map(tuple, held[:, 0, 0].tolist())) == sorted(newest)
    loaded.add(0, NumberedRows(0, (5,)).rows())
    disk.save()
    assert_same(loaded, Disk(tmp_path, make_replay(after)).load().replay)


def test_read_refuses_replays_of_other_sizes(tmp_path):
    with pytest.raises(UserError, match="holds no save"):
        Disk(tmp_path, make_replay()).load()
    Disk(tmp_path, make_filled_replay()).save()
    for other in (
        make_replay(lanes=2),
        Replay(60, 2, 2, 1, CPU, 2),
        Replay(60, 1, 3, 1, CPU, 2),
        Replay(60, 1, 2, 1, CPU),
    ):
        with pytest.raises(UserError, match="this run"):
            Disk(tmp_path, other).load()


def test_newest_refuses_a_log_with_missing_frames(tmp_path):
    Disk(tmp_path, make_filled_replay()).save()
    (path,) = (tmp_path / "logs").iterdir()
    os.truncate(path, 10 * 64 * 64 * 3)
    with pytest.raises(DamageError, match="it has 122,880 bytes and must have 282,624"):
        Disk(tmp_path, make_replay()).load()


def test_write_saved_raises_the_error_of_the_disk(tmp_path):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    for size in (10, 10**5, 10**6):  # torch itself would raise errors of other types, which depend on the size
        resource.setrlimit(resource.RLIMIT_FSIZE, (4 * size, limits[1]))
        try:
            with pytest.raises(OSError, match="File too large"):
                write_saved({"values": torch.zeros(size), "more": torch.zeros(50)}, tmp_path / "file")
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
