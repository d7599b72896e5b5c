"""Files that users give are read within limits, and errors repeat little of them."""

import os
import pickle

import pytest

from latentplan.config import EnvironmentFault, UserError
from latentplan.config.checks import cut, nearest, shown
from latentplan.config.reading import DEEPEST, is_shallow, parse_json, read_bytes, read_text, read_yaml


def test_read_text_follows_links_to_regular_files_up_to_a_size(tmp_path):
    (tmp_path / "file").write_text("é" * 10)
    (tmp_path / "link").symlink_to(tmp_path / "file")
    assert read_text(tmp_path / "link", largest=20) == "é" * 10
    with pytest.raises(UserError, match="more than 19 bytes"):
        read_text(tmp_path / "file", largest=19)


def test_read_bytes_allocates_what_a_file_holds_not_what_it_may_hold(tmp_path):
    (tmp_path / "file").write_bytes(bytes(range(256)) * 10_000)
    assert read_bytes(tmp_path / "file", largest=2**60) == bytes(range(256)) * 10_000


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("/dev/zero", "not a regular file"),
        ("pipe", "not a regular file"),
        (".", "a folder"),
        ("missing", "No such file"),
        ("loop", "Too many levels of symbolic links"),
        ("latin", "not a text file"),
        ("a\0b", "no such name"),
        ("x" * 5000, "File name too long"),
    ],
)
def test_read_text_refuses_everything_else(name, words, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    (tmp_path / "latin").write_bytes(b"\xe9")
    with pytest.raises(UserError, match=words) as error:
        read_text(tmp_path / name)
    assert len(str(error.value)) < 500


def test_read_yaml_reads_plain_values_to_a_depth(tmp_path):
    path = tmp_path / "file.yaml"
    path.write_text("a: {b: [1, 2.5, true, null, text]}")
    assert read_yaml(path) == {"a": {"b": [1, 2.5, True, None, "text"]}}
    path.write_text("[" * DEEPEST + "]" * DEEPEST)
    assert read_yaml(path) is not None
    path.write_text("[" * (DEEPEST + 1) + "]" * (DEEPEST + 1))
    with pytest.raises(UserError, match=f"nested more than {DEEPEST} levels"):
        read_yaml(path)


@pytest.mark.parametrize("text", ["[" * 10**5, "{a: " * 10**5, "- " * 10**5, "? " * 10**5])
def test_deep_texts_are_noticed_without_recursion(text):
    assert not is_shallow(text)
    with pytest.raises(UserError, match=r"nested too deeply|Expecting"):
        parse_json(text, "file")


@pytest.mark.parametrize(
    ("text", "expected"),
    [("[1, 2]", True), ("a: b: c", True), ("'", True), ("\0", True), ("*alias", False), ("a: &a 1\nb: *a", False)],
)
def test_short_texts_are_shallow_or_no_yaml_unless_they_have_aliases(text, expected):
    assert is_shallow(text) == expected


def test_cut_shortens_long_words_and_long_messages():
    assert cut("as it is") == "as it is"
    words = cut(f"cannot read {'a' * 5000}: no such file")
    assert words.startswith("cannot read aaa") and words.endswith("aaa: no such file") and len(words) < 240
    assert cut("a b " * 250) == "a b " * 250  # a text of 1,000 characters with spaces stays
    assert len(cut("a b " * 250 + "a")) <= 200 and len(cut("a b " * 10**6)) <= 200
    assert len(str(UserError("x" * 10**6))) <= 200


VALUES = {
    "text": "x" * 10**6,
    "bytes": b"x" * 10**6,
    "number": 16**100_000,
    "numbers": [[16**100_000]],
    "nested": {"a": [[[[[1]]]]]},
    "lines": "a\nb",
}


@pytest.mark.parametrize("value", VALUES.values(), ids=VALUES)
def test_shown_is_short_for_any_value(value):
    assert len(shown(value)) <= 63 and "\n" not in shown(value)


def test_shown_says_how_long_a_number_is():
    assert shown(16**100_000) == "a number of 120412 digits"


def test_nearest_takes_a_short_time_for_long_names():
    assert nearest("planer" + "x" * 10**6, ["planner"], cutoff=0.0) == "planner"
    assert nearest("q", ["planner"]) is None


def test_environment_fault_keeps_its_origin_between_processes():
    fault = pickle.loads(pickle.dumps(EnvironmentFault("it failed", "Traceback")))
    assert (str(fault), fault.origin, fault.__notes__) == ("it failed", "Traceback", ["Traceback"])
    assert not hasattr(EnvironmentFault("it failed"), "__notes__")
