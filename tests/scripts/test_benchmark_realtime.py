import json
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from latentplan.agents.checkpoint import save_checkpoint
from latentplan.config import Config, EnvConfig, ModelConfig, PlannerConfig
from latentplan.models import WorldModel

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))

import benchmark  # noqa: E402
from bench.clocked import AGENTS, ITERATIONS, REPLAN_EVERY  # noqa: E402
from bench.realtime import PARTS, part_table  # noqa: E402
from bench.soak import IDLE, IdleAgent, Tally, play_block, soak_rows, soak_table, take_turns  # noqa: E402

ENV = EnvConfig(domain="cartpole", task="swingup", action_repeat=100, render_quality="fastest")
MODEL = ModelConfig(deter_dim=8, hidden_dim=8, encoder_channels=(4, 4), decoder_channels=2, num_bins=5)
PLANNER = PlannerConfig(horizon=3, num_samples=8, num_elites=2, num_policy_samples=2, num_iterations=2)
FRAMES = [np.zeros((64, 64, 3), np.uint8)] * 10


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    """An untrained agent for ten-decision episodes of cartpole."""
    folder = tmp_path_factory.mktemp("agent")
    info = {"domain": "cartpole", "task": "swingup", "env_frames": 1234, "discount": 0.9, "metrics": {}}
    torch.manual_seed(0)
    save_checkpoint(folder, WorldModel(MODEL, action_dim=1), Config(env=ENV, model=MODEL, planner=PLANNER), info)
    return folder


@pytest.fixture(scope="module")
def measured(checkpoint, tmp_path_factory):
    """Everything that `benchmark.py realtime` measures, and the folder of its files."""
    folder = tmp_path_factory.mktemp("realtime")
    flags = ["--episodes", 1, "--rates", 50, "--device", "cpu", "--json", folder / "r.json", "--plot", folder / "r.png"]
    assert benchmark.main(["realtime", "--checkpoint", str(checkpoint), *map(str, flags)]) == 0
    return json.loads((folder / "r.json").read_text()), folder


def sleeper(milliseconds):
    """Takes as long for every decision."""

    class Sleeper(IdleAgent):
        def act(self, frame):
            time.sleep(milliseconds / 1000.0)

    return Sleeper()


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["realtime"], "--checkpoint"),
        (["realtime", "--checkpoint", "x", "--parts", "rate"], "'rates'"),
        (["realtime", "--checkpoint", "x", "--rates", "50,0"], "--rates"),
        (["realtime", "--checkpoint", "no-such-folder"], "no-such-folder"),
        (["soak"], "--checkpoint"),
        (["soak", "--checkpoint", "x", "--mode", "gate"], "'gated'"),
        (["soak", "--checkpoint", "x", "--control-hz", "nan"], "--control-hz"),
        (["soak", "--checkpoint", "no-such-folder"], "no-such-folder"),
    ],
)
def test_main_refuses_bad_flags_in_one_line_that_names_the_flag(capsys, arguments, named):
    assert benchmark.main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("error: ") and captured.err.count("\n") == 1
    assert named in captured.err


def test_every_point_of_every_part_is_measured(measured):
    result, folder = measured
    assert [row["iterations"] for row in result["iterations"]] == list(ITERATIONS)
    assert [row["agent"] for row in result["rates"]] == list(AGENTS)
    assert [row["replan_every"] for row in result["replan"]] == list(REPLAN_EVERY)
    assert [row["horizon"] for row in result["replan"]] == [3, 3, 5, 10, 20]
    assert [row["step"] for row in result["error"]] == list(range(1, 9))
    for part in ("iterations", "rates", "replan"):
        assert all(len(row["returns"]) == 1 and row["decision_ms"]["p50"] > 0.0 for row in result[part])
    assert {row["control_hz"] for row in result["rates"]} == {50.0}
    assert (folder / "r.png").stat().st_size > 0


def test_tables_have_a_line_per_point(measured):
    result, _ = measured
    for part in PARTS:
        assert len(part_table(part, result[part]).splitlines()) == 2 + len(result[part])


def test_errors_are_those_of_imagination_and_of_no_change(measured):
    result, _ = measured
    for row in result["error"]:
        assert all(np.isfinite(row[name]) for name in ("latent_distance", "reward_error", "reward_change"))
    assert result["error"][0]["latent_change"] > 0.0


def test_parts_are_chosen(tmp_path, checkpoint):
    path = tmp_path / "r.json"
    flags = ["--parts", "error", "--episodes", "1", "--device", "cpu", "--json", str(path)]
    assert benchmark.main(["realtime", "--checkpoint", str(checkpoint), *flags]) == 0
    assert set(PARTS) & json.loads(path.read_text()).keys() == {"error"}


def test_a_soak_counts_every_agent_beside_one_that_does_nothing(tmp_path, checkpoint, capsys):
    path = tmp_path / "soak.json"
    flags = ["--mode", "actor,gated", "--control-hz", "100", "--decisions", "30", "--block", "20", "--device", "cpu"]
    assert benchmark.main(["soak", "--checkpoint", str(checkpoint), *flags, "--json", str(path)]) == 0
    agents = json.loads(path.read_text())["agents"]
    assert list(agents) == [IDLE, "actor", "gated"]
    for facts in agents.values():
        assert facts["decisions_due"] == 30
        assert 0 <= facts["deadline_misses"] < 30
        assert facts["minus_no_op"] == pytest.approx(facts["misses_per_10000"] - agents[IDLE]["misses_per_10000"])
    assert "minus no-op" in capsys.readouterr().out


def test_boundaries_that_pass_while_an_agent_is_busy_are_missed():
    tally = Tally()
    play_block(sleeper(25.0), FRAMES, 100.0, 9, tally)  # at least two boundaries of 10 ms pass in each decision
    assert tally.due == 9
    assert tally.misses >= 6
    assert len(tally.decision_ms) + tally.misses == 9
    assert min(tally.decision_ms) >= 25.0


def test_a_block_that_is_interrupted_counts_what_was_due():
    class Interrupted:
        count = 0

        def act(self, frame):
            self.count += 1
            if self.count == 3:
                raise KeyboardInterrupt
            time.sleep(0.025)

    tally = Tally()
    with pytest.raises(KeyboardInterrupt):
        play_block(Interrupted(), FRAMES, 100.0, 50, tally)
    assert tally.due == 2 + tally.misses


def test_agents_take_turns_block_by_block():
    turns = []

    class Noting(IdleAgent):
        def __init__(self, name):
            self.name = name

        def reset(self):
            turns.append(self.name)

    agents = {IDLE: Noting(IDLE), "actor": Noting("actor")}
    tallies = {name: Tally() for name in agents}
    take_turns(agents, FRAMES, 1000.0, 25, 10, tallies)
    assert turns == [IDLE, "actor"] * 3
    assert [tally.due for tally in tallies.values()] == [25, 25]


def test_misses_are_told_beyond_those_of_the_machine():
    tallies = {IDLE: Tally(1000, 1, [0.1], [0.2]), "actor": Tally(500, 2, [1.0], [0.2]), "gated": Tally()}
    rows = soak_rows(tallies)
    assert list(rows) == [IDLE, "actor"]
    assert rows["actor"]["misses_per_10000"] == pytest.approx(40.0)
    assert rows["actor"]["minus_no_op"] == pytest.approx(30.0)
    assert "+30.0" in soak_table(rows)
