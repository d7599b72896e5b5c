"""Files that are replaced as a whole."""

import os

import pytest

from latentplan.config.writing import remove_parts, replaced_whole, write_whole


def test_replaced_whole_keeps_the_file_when_the_block_fails(tmp_path):
    path = tmp_path / "file"
    path.write_text("old")
    with pytest.raises(ZeroDivisionError), replaced_whole(path) as part:
        part.write_text("half")
        assert path.read_text() == "old"
        raise ZeroDivisionError
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_write_whole_replaces_a_file_and_leaves_nothing_beside_it(tmp_path):
    path = tmp_path / "file"
    path.write_text("old")
    assert write_whole(path, "one\r\ntwo é\n").read_bytes() == "one\r\ntwo é\n".encode()
    assert list(tmp_path.iterdir()) == [path]


def test_write_whole_does_not_follow_a_link_beside_the_file(tmp_path):
    (tmp_path / "other").write_text("kept")
    (tmp_path / f".file.{os.getpid()}").symlink_to(tmp_path / "other")
    write_whole(tmp_path / "file", "new")
    assert (tmp_path / "other").read_text() == "kept" and not (tmp_path / "file").is_symlink()


def test_remove_parts_removes_what_killed_processes_left(tmp_path):
    child = os.fork()
    if child == 0:
        os._exit(0)
    os.waitpid(child, 0)
    for end in (child, os.getpid(), os.getppid(), "old", "0"):
        (tmp_path / f".file.{end}").touch()
    (tmp_path / f".other.{child}").touch()
    remove_parts(tmp_path / "file")
    left = {".file.0", ".file.old", f".file.{os.getppid()}", f".other.{child}"}
    assert {path.name for path in tmp_path.iterdir()} == left
