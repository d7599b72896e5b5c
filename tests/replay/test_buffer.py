"""Examples of what replay holds, draws and refuses; `test_replay_properties.py` has the laws for any replay."""

from pathlib import Path

import pytest
import torch

from latentplan.config import UserError
from latentplan.replay import memory
from latentplan.replay.memory import count_replay_bytes
from tests.replay.numbered_rows import (
    NumberedRows,
    assert_aligned,
    frame_values,
    make_filled_replay,
    make_replay,
    sample,
)

RINGS = [
    pytest.param({}, id="one lane"),
    pytest.param({"capacity": 120, "lanes": 3}, id="three lanes"),
    pytest.param({"capacity": 17, "lengths": (7, 4, 9, 6, 8)}, id="overwritten"),
    pytest.param({"capacity": 40, "lanes": 3, "lengths": (7, 4, 9, 6, 8), "chunk": 11}, id="lanes overwritten"),
    pytest.param({"capacity": 12, "lengths": (7, 4, 9), "chunk": 23}, id="more at once than fits"),
]


@pytest.mark.parametrize("ring", RINGS)
def test_draw_reaches_every_sequence_that_is_held(ring):
    replay, length = make_filled_replay(**ring), 3
    drawn = {tuple(start) for start in torch.stack(frame_values(sample(replay, 1000, length)), -1)[:, 0].tolist()}
    rows = replay.frames[:, 0, 0].float()
    held = {tuple(row) for row in rows.tolist()} if len(replay) == len(rows) else None
    lanes, lengths = ring.get("lanes", 1), ring.get("lengths", (7, 4, 9))
    for lane in range(lanes):
        for episode, decisions in enumerate(lengths):
            for start in range(decisions - length + 1):
                first = (start, episode, lane)
                is_held = held is None or {(start + ahead, episode, lane) for ahead in range(length + 1)} <= held
                assert (first in drawn) == is_held, first


def test_draw_ends_an_interrupted_episode_where_the_next_begins():
    replay, numbered = make_replay(), NumberedRows(0, (9,))
    replay.add(0, numbered.rows(0, 4))  # the run stopped here, and a resumed run begins a new episode
    replay.add(0, numbered.rows(0, 6))
    for seed in range(5):
        assert_aligned(sample(replay, seed=seed))


def test_add_stores_each_frame_once():
    replay = make_filled_replay(lengths=(7, 4, 9))
    assert len(replay) == 8 + 5 + 10
    stored = {tuple(frame) for frame in replay.frames[: len(replay), 0, 0].tolist()}
    assert len(stored) == len(replay)
    assert replay.frames.numel() == 60 * 64 * 64 * 3


@pytest.mark.parametrize("lengths", [(), (2,), (4, 4, 4)])
def test_draw_names_the_sequence_length_when_episodes_are_too_short(lengths):
    replay = make_filled_replay(lengths=lengths)
    with pytest.raises(UserError, match=r"sequence_length \(5\)"):
        sample(replay, length=5)


def test_draw_advises_more_capacity_when_a_lane_is_too_small():
    with pytest.raises(UserError, match="raise --replay.capacity"):
        sample(make_filled_replay(lengths=(9,), capacity=4), length=5)


@pytest.mark.parametrize(
    ("lengths", "advice"), [((4, 4, 4), "lower --learning.sequence_length"), ((2,), "raise --collection.prefill")]
)
def test_draw_advises_by_the_reason_that_no_sequence_fits(lengths, advice):
    with pytest.raises(UserError, match=advice):
        sample(make_filled_replay(lengths=lengths), length=5)


def test_draw_takes_an_episode_of_exactly_the_sequence_length():
    assert_aligned(sample(make_filled_replay(lengths=(2, 5, 3)), length=5))


def test_replay_refuses_more_than_nine_tenths_of_the_free_memory(monkeypatch):
    monkeypatch.setattr(memory, "free_memory", lambda: count_replay_bytes(100, 1, 2, 2))
    make_replay(capacity=90)
    with pytest.raises(UserError, match=r"^the replay takes about .* but cpu has .* free: lower --replay\.capacity"):
        make_replay(capacity=91)


def test_count_replay_bytes_equals_the_size_of_the_arrays():
    replay = make_replay(capacity=10, lanes=3)
    arrays = [replay.frames, replay.deter, replay.actions, replay.rewards, replay.continues, replay.labels]
    held = sum(array.numel() * array.element_size() for array in arrays) + replay.episode.nbytes + replay.is_end.nbytes
    assert held == replay.num_bytes


def test_free_memory_is_known_or_unlimited_without_proc(monkeypatch):
    monkeypatch.setattr(memory, "MEMORY_FACTS", Path("/nowhere"))
    monkeypatch.setattr(memory, "LIMIT_FACTS", Path("/nowhere"))
    assert memory.free_memory() > 2**28


@pytest.mark.parametrize(("limit", "left"), [("4096", 4096 - 3000 + 500 + 300), ("2000", 0)])
def test_free_memory_is_the_rest_of_a_containers_limit(tmp_path, monkeypatch, limit, left):
    for name, text in {
        "max": limit,
        "current": "3000",
        "stat": "anon 2000\ninactive_file 500\nactive_file 300",
    }.items():
        (tmp_path / f"memory.{name}").write_text(f"{text}\n")
    monkeypatch.setattr(memory, "LIMIT_FACTS", tmp_path)
    assert memory.free_memory() == left


def test_free_memory_is_the_machines_without_a_containers_limit(tmp_path, monkeypatch):
    for name, text in {"max": "max", "current": "3000", "stat": "anon 2000"}.items():
        (tmp_path / f"memory.{name}").write_text(f"{text}\n")
    monkeypatch.setattr(memory, "LIMIT_FACTS", tmp_path)
    assert memory.free_memory() > 2**28
