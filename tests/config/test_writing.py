"""Files that are replaced as a whole."""

import pytest

from latentplan.config.writing import replaced_whole, write_whole


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
