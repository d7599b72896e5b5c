"""`scripts/eval.py` in a world that does not wait."""

import json

import cv2
import pytest
import torch

from latentplan.agents.checkpoint import save_checkpoint
from latentplan.commands import evaluate
from latentplan.config import Config, EnvConfig, ModelConfig, PlannerConfig
from latentplan.models import WorldModel

ENV = EnvConfig(domain="cartpole", task="swingup", action_repeat=100, render_quality="fastest")
MODEL = ModelConfig(deter_dim=8, hidden_dim=8, encoder_channels=(4, 4), decoder_channels=2, num_bins=5)
PLANNER = PlannerConfig(horizon=3, num_samples=8, num_elites=2, num_policy_samples=1, num_iterations=2)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    """An untrained agent for ten-decision episodes of cartpole."""
    folder = tmp_path_factory.mktemp("agent")
    info = {"domain": "cartpole", "task": "swingup", "env_frames": 1234, "discount": 0.9, "metrics": {}}
    torch.manual_seed(0)
    save_checkpoint(folder, WorldModel(MODEL, action_dim=1), Config(env=ENV, model=MODEL, planner=PLANNER), info)
    return folder


def result_of(tmp_path, checkpoint, *flags):
    path = tmp_path / "result.json"
    arguments = ["--checkpoint", checkpoint, "--device", "cpu", "--json", path, *flags]
    assert evaluate.main([str(word) for word in arguments]) == 0
    return json.loads(path.read_text())


@pytest.fixture
def zeros(tmp_path):
    path = tmp_path / "zeros.txt"
    path.write_text("0\n")
    return path


@pytest.mark.parametrize("mode", ["planner", "background"])
def test_thinking_that_costs_nothing_earns_what_a_world_that_waits_pays(tmp_path, checkpoint, zeros, mode):
    flags = ("--mode", mode, "--episodes", 2)
    waiting = result_of(tmp_path, checkpoint, *flags)
    timed = result_of(tmp_path, checkpoint, *flags, "--control-hz", 50, "--latency", zeros)
    assert timed["returns"] == waiting["returns"]
    assert (timed["deadline_misses"], timed["control_hz"], timed["latency"]) == (0, 50.0, str(zeros))
    assert (waiting["deadline_misses"], waiting["control_hz"], waiting["latency"]) == (0, None, None)
    assert timed["action_source"] == waiting["action_source"]
    assert timed["decision_ms"] == {"p50": 0.0, "p95": 0.0, "p99": 0.0}


@pytest.mark.parametrize("mode", ["planner", "background"])
def test_a_given_latency_gives_the_same_result_twice_and_changes_the_return(tmp_path, checkpoint, mode):
    spread = tmp_path / "spread.json"
    spread.write_text('{"decision_ms": [5, 15, 45, 70]}')
    flags = ("--mode", mode, "--episodes", 2, "--control-hz", 20, "--latency", spread)
    first, again = (result_of(tmp_path, checkpoint, *flags) for _ in range(2))
    assert first == again
    assert first["deadline_misses"] > 0
    assert sum(first["action_source"].values()) + first["deadline_misses"] == 2 * 10
    assert first["returns"] != result_of(tmp_path, checkpoint, *flags[:4])["returns"]


@pytest.mark.parametrize(
    ("mode", "source", "fraction"), [("planner", "plan", 1.0), ("actor", "actor", 0.0), ("random", "actor", 0.0)]
)
def test_results_tell_where_actions_came_from(tmp_path, checkpoint, mode, source, fraction):
    latency = tmp_path / "latency.txt"
    latency.write_text("10\n")
    flags = ("--mode", mode, "--episodes", 1, "--control-hz", 20, "--latency", latency)
    result = result_of(tmp_path, checkpoint, *flags)
    assert result["action_source"] == {name: 10 if name == source else 0 for name in ("plan", "tail", "actor")}
    assert result["planned_fraction"] == fraction
    assert result["plan_age_ms"] == ({"p50": 10.0, "p95": 10.0, "p99": 10.0} if fraction else None)


def test_a_measured_latency_is_what_decisions_took(tmp_path, checkpoint):
    result = result_of(tmp_path, checkpoint, "--episodes", 1, "--control-hz", 1e-6)
    assert result["latency"] == "measured"
    assert 0.0 < result["decision_ms"]["p50"] < 1e9
    assert result["deadline_misses"] == 0


def test_a_film_of_a_world_that_does_not_wait_shows_every_period(tmp_path, checkpoint):
    path, latency = tmp_path / "film.mp4", tmp_path / "latency.txt"
    latency.write_text("70\n")
    flags = ("--episodes", 1, "--control-hz", 20, "--latency", latency, "--video", path)
    assert result_of(tmp_path, checkpoint, *flags)["deadline_misses"] == 5
    capture, count = cv2.VideoCapture(str(path)), 0
    while capture.grab():
        count += 1
    assert count == 11


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (("--control-hz", "0"), "--control-hz must be a number above 0, got '0'"),
        (("--control-hz", "-5"), "'-5'"),
        (("--control-hz", "nan"), "'nan'"),
        (("--control-hz", "fast"), "'fast'"),
        (("--latency", "measured"), "--control-hz"),
        (("--control-hz", "50", "--latency", "no-such-file"), "no-such-file"),
    ],
)
def test_a_clock_that_cannot_be_is_one_line(capsys, checkpoint, flags, words):
    assert evaluate.main(["--checkpoint", str(checkpoint), *flags]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("error: ") and captured.err.count("\n") == 1
    assert words in captured.err
