"""Commits: at every moment one save is whole, and every changed bit is noticed."""

import hashlib
import json
import os
import random
import shutil
from pathlib import Path

import pytest

from latentplan.config import UserError
from latentplan.config import commit as module
from latentplan.config.commit import MANIFEST, DamageError, Extent, Log, Saves, read_manifest, write_manifest
from tests.killing import die_at, in_child

ROW = 32
CALLS = ((os, "fsync"), (os, "rename"), (os, "truncate"), (shutil, "rmtree"), (Path, "rename"))


class Diary:
    """Saves of a counter: a file with the counter, and a log with one row for each save."""

    def __init__(self, folder):
        self.saves, self.log = Saves(folder, "diary", 1), Log(folder, "rows", ROW, rows_per_file=3)
        self.count = 0
        if self.saves.exist():
            save, self.problems = self.saves.newest()
            self.count = int((save.folder / "count").read_text())
            self.log.restore(save.logs)

    def write(self, part):
        self.log.append(self.count, iter([bytes([self.count]) * ROW]))
        (part / "count").write_text(str(self.count + 1))
        return self.log.extents()

    def add(self):
        self.saves.commit(self.write, {"count": self.count + 1})
        self.count += 1

    def rows(self):
        return [row for _, count, path in self.log.rows() for row in path.read_bytes()[: count * ROW : ROW]]


@pytest.fixture
def folder(tmp_path):
    diary = Diary(tmp_path / "saves")
    for _ in range(5):
        diary.add()
    return tmp_path / "saves"


def test_newest_is_whole_wherever_a_commit_is_killed(folder, tmp_path):
    def add():
        die_at(call, *CALLS)
        diary.add()

    for call in range(100):
        own = shutil.copytree(folder, tmp_path / str(call))
        diary = Diary(own)
        is_finished = in_child(add)
        after = Diary(own)
        assert after.problems == [] and after.count in (5, 6) and after.rows() == list(range(after.count)), call
        after.saves.remove_leftovers()
        after.add()  # and the next save can be made
        assert Diary(own).rows() == list(range(after.count))
        assert not list(own.glob("*.part"))
        if is_finished:
            break
    assert is_finished and call > 5


def test_commit_keeps_two_saves_and_removes_what_they_do_not_name(folder):
    assert sorted(path.name for path in folder.iterdir()) == ["logs", "save-000004", "save-000005"]
    diary = Diary(folder)
    diary.log.drop_before(4)
    diary.add()
    diary.add()
    assert sorted(path.name for path in folder.iterdir()) == ["logs", "save-000006", "save-000007"]
    assert sorted(path.name for path in (folder / "logs").iterdir()) == ["rows-000000000003", "rows-000000000006"]


def test_newest_falls_back_to_the_save_before(folder):
    (folder / "save-000005" / "count").write_text("6")
    diary = Diary(folder)
    assert diary.count == 4 and len(diary.problems) == 1 and "count is damaged" in diary.problems[0]
    diary.add()
    assert Diary(folder).problems == [] and Diary(folder).rows() == [0, 1, 2, 3, 4]
    assert sorted(path.name for path in folder.glob("save*")) == ["save-000004", "save-000006"]


def test_newest_refuses_a_folder_without_a_whole_save(folder, tmp_path):
    with pytest.raises(UserError, match="holds no save"):
        Saves(tmp_path / "empty", "diary", 1).newest()
    for save in folder.glob("save*"):
        (save / "count").unlink()
    with pytest.raises(DamageError, match="no save in .* is whole: .*count cannot be read"):
        Saves(folder, "diary", 1).newest()


def test_newest_notices_every_flipped_bit(folder):
    rng = random.Random(0)
    paths = [*(folder / "save-000005").iterdir(), *(folder / "logs").iterdir()]
    saves = Saves(folder, "diary", 1)
    for path in paths:
        before = path.read_bytes()
        for place in [0, len(before) - 1, *(rng.randrange(len(before)) for _ in range(40))]:
            content = bytearray(before)
            content[place] ^= 1 << rng.randrange(8)
            path.write_bytes(content)
            with pytest.raises(DamageError):
                saves.verify(folder / "save-000005")
        for content in (b"", before[:-1], before + b" " if path.parent.name != "logs" else before[:1]):
            path.write_bytes(content)
            with pytest.raises(DamageError):
                saves.verify(folder / "save-000005")
        path.write_bytes(before)
    saves.verify(folder / "save-000005")


def test_verify_ignores_log_bytes_after_the_committed_ones(folder):
    with (folder / "logs" / "rows-000000000003").open("ab") as file:
        file.write(b"begun by a save that was not finished")
    diary = Diary(folder)
    assert diary.problems == []
    diary.add()
    assert Diary(folder).rows() == list(range(6))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda values: values | {"more": 1}, "must hold"),
        (lambda values: values | {"note": {"count": 99}}, "its own checksum differs"),
        (lambda values: values | {"files": {"../count": {"bytes": 1, "sha256": ""}}}, "names the file"),
        (lambda values: values | {"files": {"count": {"bytes": -1, "sha256": ""}}}, "no size"),
        (lambda values: values | {"kind": 1}, "kind must be a text"),
        (lambda values: values | {"format": True}, "format a whole number"),
        (lambda values: values | {"note": 5}, "note must hold plain values"),
        (lambda values: values | {"note": {"count": [5]}}, "note must hold plain values"),
        (lambda values: values | {"files": {"logs/count": {"bytes": 1, "sha256": ""}}}, "names the file"),
        (lambda values: values | {"files": {"count": {"bytes": True, "sha256": "0" * 64}}}, "no size"),
        (lambda values: values | {"files": {"count": {"bytes": 1, "sha256": 5}}}, "no checksum"),
        (lambda values: values | {"logs": {"logs/rows-abc": {"bytes": 1, "sha256": "0" * 64}}}, "names the file"),
        (lambda values: [values], "must hold"),
        (lambda values: "text", "must hold"),
    ],
)
def test_read_manifest_refuses_what_it_does_not_know(folder, change, message):
    path = folder / "save-000005" / MANIFEST
    path.write_text(json.dumps(change(json.loads(path.read_text()))))
    with pytest.raises(DamageError, match=message) as caught:
        read_manifest(path.parent, "diary", 1)
    assert "\n" not in str(caught.value)


def test_read_manifest_refuses_depth_and_bytes_in_one_line(folder):
    path = folder / "save-000005" / MANIFEST
    for content in (b"[" * 100_000, b"\xff\xfe", b""):
        path.write_bytes(content)
        with pytest.raises(DamageError, match="is damaged") as caught:
            read_manifest(path.parent, "diary", 1)
        assert "\n" not in str(caught.value) and len(str(caught.value)) < 400


def test_read_manifest_does_not_wait_for_a_pipe(folder):
    path = folder / "save-000005" / MANIFEST
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(DamageError, match="not a regular file"):
        read_manifest(path.parent, "diary", 1)


@pytest.mark.parametrize("content", ["[" * 100_000, "{}", "[]", '{"kind": 1}'])
def test_kinds_ignores_manifests_that_cannot_be_read(folder, content):
    (folder / "save-000004" / MANIFEST).write_text(content)
    assert Saves(folder, "run", 1).kinds() - {"1"} == {"diary"}


@pytest.mark.parametrize("replace", [os.mkfifo, lambda path: path.symlink_to(path.with_name("rows-000000000000"))])
def test_newest_refuses_a_log_that_is_not_a_file(folder, replace):
    write_empty_log(folder, "logs/rows-000000000009")
    replace(folder / "logs" / "rows-000000000009")
    with pytest.raises(DamageError, match="rows-000000000009 is damaged: it is not a regular file"):
        Saves(folder, "diary", 1).newest()


def write_empty_log(folder, name):
    """Seals all saves again, with a log of no bytes."""
    for save in folder.glob("save*"):
        old = read_manifest(save, "diary", 1)
        write_manifest(save, "diary", 1, old.note, {**old.logs, name: Extent(0, hashlib.sha256(b"").hexdigest())})


def test_append_does_not_follow_a_link(folder, tmp_path):
    (tmp_path / "other").write_text("kept")
    diary = Diary(folder)
    for name in ("rows-000000000003", "rows-000000000006"):
        (folder / "logs" / name).unlink(missing_ok=True)
        (folder / "logs" / name).symlink_to(tmp_path / "other")
    with pytest.raises((OSError, DamageError)):
        diary.add()
    diary.log.restore({})
    diary.log.append(6, iter([bytes(ROW)]))
    assert (tmp_path / "other").read_text() == "kept" and not (folder / "logs" / "rows-000000000006").is_symlink()


@pytest.mark.parametrize("damage", [os.unlink, lambda path: os.truncate(path, ROW), lambda path: path.write_bytes(b"")])
def test_append_refuses_a_log_that_has_lost_rows(folder, damage):
    diary = Diary(folder)
    damage(folder / "logs" / "rows-000000000003")
    with pytest.raises((OSError, DamageError), match="rows-000000000003"):
        diary.add()


def change_content(path):
    path.write_bytes(b"x" * path.stat().st_size)


@pytest.mark.parametrize("damage", [os.unlink, lambda path: os.truncate(path, ROW), change_content])
@pytest.mark.parametrize("first", [0, 3])
def test_forget_changed_forgets_the_first_changed_file_and_later_rows(folder, damage, first):
    log = Diary(folder).log
    damage(folder / "logs" / f"rows-{first:012d}")
    assert log.forget_changed() == log.path(first) and log.end == first
    log.append(first, iter([bytes([row]) * ROW for row in range(first, 5)]))
    assert log.forget_changed() is None
    assert Diary(folder).rows() == list(range(5))  # both saves are whole again


def test_forget_changed_reads_a_file_with_another_time_once(folder, monkeypatch):
    log, path = Diary(folder).log, folder / "logs" / "rows-000000000003"
    os.utime(path, ns=(0, 0))
    assert log.forget_changed() is None
    monkeypatch.setattr(module, "check_extent", pytest.fail)
    assert log.forget_changed() is None


def test_newest_refuses_another_format_and_skips_another_kind(folder, tmp_path):
    with pytest.raises(UserError, match="has format 1, this version of latentplan reads format 2"):
        Saves(folder, "diary", 2).newest()
    with pytest.raises(DamageError, match="describes a diary, not a run"):
        Saves(folder, "run", 1).newest()
    assert Saves(folder, "run", 1).kinds() == {"diary"}


def test_commit_that_fails_leaves_nothing(folder):
    diary, before = Diary(folder), sorted(folder.rglob("*"))

    def fail(part):
        (part / "large").write_text("text")
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        diary.saves.commit(fail, {})
    assert sorted(folder.rglob("*")) == before


def test_append_that_fails_keeps_dropped_files_that_the_save_before_names(folder, monkeypatch):
    diary, before = Diary(folder), {path: path.read_bytes() for path in (folder / "logs").iterdir()}
    diary.log.drop_before(4)
    calls = iter(range(10**6))

    def fill_up(descriptor):
        if next(calls) == 2:
            raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", fill_up)
        with pytest.raises(OSError, match="No space left"):
            diary.log.append(5, iter([bytes([row]) * ROW for row in range(5, 9)]))
    left = {path: path.read_bytes() for path in (folder / "logs").iterdir() if path.stat().st_size}
    assert len(before) == 2 and left == before  # and the rows of the append are gone
    assert Diary(folder).problems == [] and Diary(folder).rows() == list(range(5))
    shutil.rmtree(folder / "save-000005")
    assert Diary(folder).count == 4 and Diary(folder).rows() == list(range(4))


def test_find_returns_the_newest_whole_copy_of_a_file(folder):
    saves = Saves(folder, "diary", 1)
    assert saves.find("count").read_text() == "5"
    (folder / "save-000005" / "count").write_text("x")
    assert saves.find("count").read_text() == "4"
    assert saves.find("other") is None


def test_write_manifest_describes_files_without_their_suffix(tmp_path):
    (tmp_path / "one.part").write_text("1")
    (tmp_path / "other").write_text("2")
    write_manifest(tmp_path, "pair", 1, {}, {}, names=["one"], suffix=".part")
    (tmp_path / f"{MANIFEST}.part").rename(tmp_path / MANIFEST)
    assert list(read_manifest(tmp_path, "pair", 1).files) == ["one"]
