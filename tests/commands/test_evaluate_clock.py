"""`scripts/eval.py` in a world that does not wait."""

import pytest

from tests.commands.conftest import count_frames, result_of


@pytest.fixture
def zeros(tmp_path):
    path = tmp_path / "zeros.txt"
    path.write_text("0\n")
    return path


@pytest.mark.parametrize("mode", ["planner", "background"])
def test_zero_latency_gives_the_returns_of_a_world_that_waits(tmp_path, checkpoint, zeros, mode):
    flags = ("--mode", mode, "--episodes", 1)
    waiting = result_of(tmp_path, checkpoint, *flags)
    timed = result_of(tmp_path, checkpoint, *flags, "--control-hz", 50, "--latency", zeros)
    assert timed["returns"] == waiting["returns"]
    assert (timed["deadline_misses"], timed["control_hz"], timed["latency"]) == (0, 50.0, str(zeros))
    assert (waiting["deadline_misses"], waiting["control_hz"], waiting["latency"]) == (0, None, None)
    assert timed["action_source"] == waiting["action_source"]
    assert timed["decision_ms"] == {"p50": 0.0, "p95": 0.0, "p99": 0.0}


@pytest.mark.parametrize("mode", ["planner", "background"])
def test_given_latency_repeats_exactly_and_changes_the_returns(tmp_path, checkpoint, mode):
    spread = tmp_path / "spread.json"
    spread.write_text('{"decision_ms": [5, 15, 45, 70]}')
    flags = ("--mode", mode, "--episodes", 1, "--control-hz", 20, "--latency", spread)
    first, again = (result_of(tmp_path, checkpoint, *flags) for _ in range(2))
    assert first == again
    assert first["deadline_misses"] > 0
    assert sum(first["action_source"].values()) + first["deadline_misses"] == 10
    assert first["returns"] != result_of(tmp_path, checkpoint, *flags[:4])["returns"]


@pytest.mark.parametrize(
    ("mode", "source", "fraction"), [("planner", "plan", 1.0), ("actor", "actor", 0.0), ("random", "actor", 0.0)]
)
def test_result_counts_where_actions_came_from(tmp_path, checkpoint, mode, source, fraction):
    latency = tmp_path / "latency.txt"
    latency.write_text("10\n")
    flags = ("--mode", mode, "--episodes", 1, "--control-hz", 20, "--latency", latency)
    result = result_of(tmp_path, checkpoint, *flags)
    assert result["action_source"] == {name: 10 if name == source else 0 for name in ("plan", "tail", "actor")}
    assert result["planned_fraction"] == fraction
    assert result["plan_age_ms"] == ({"p50": 10.0, "p95": 10.0, "p99": 10.0} if fraction else None)


def test_measured_latency_is_the_time_of_the_decisions(tmp_path, checkpoint):
    result = result_of(tmp_path, checkpoint, "--episodes", 1, "--control-hz", 1e-6)
    assert result["latency"] == "measured"
    assert 0.0 < result["decision_ms"]["p50"] < 1e9
    assert result["deadline_misses"] == 0


def test_film_of_a_world_that_does_not_wait_shows_every_period(tmp_path, checkpoint):
    path, latency = tmp_path / "film.mp4", tmp_path / "latency.txt"
    latency.write_text("70\n")
    flags = ("--episodes", 1, "--control-hz", 20, "--latency", latency, "--video", path)
    assert result_of(tmp_path, checkpoint, *flags)["deadline_misses"] == 5
    assert count_frames(path)[0] == 11


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (("--control-hz", "0"), "--control-hz must be above 0, got 0.0"),
        (("--control-hz", "-5"), "--control-hz must be above 0, got -5.0"),
        (("--control-hz", "nan"), "'nan'"),
        (("--control-hz", "fast"), "'fast'"),
        (("--latency", "measured"), "--control-hz"),
        (("--control-hz", "50", "--latency", "no-such-file"), "no-such-file"),
    ],
)
def test_eval_refuses_bad_clocks_in_one_line(assert_refused, checkpoint, flags, words):
    assert_refused(["eval", "--checkpoint", checkpoint, *flags], words)
