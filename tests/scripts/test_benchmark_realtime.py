"""`benchmark.py realtime` and `benchmark.py soak`: decisions on virtual and wall clocks."""

import json
import time
from types import SimpleNamespace

import benchmark
import numpy as np
import pytest
from bench.realtime import PARTS, part_table
from bench.realtime_measurements import AGENTS, ITERATIONS, REPLAN_EVERY, mean_errors
from bench.soak import IDLE, IdleAgent, Tally, play_block, soak_rows, soak_table, take_turns

from latentplan.config.spaces import Spaces

FRAMES = [np.zeros((64, 64, 3), np.uint8)] * 10


@pytest.fixture(scope="module")
def measured(checkpoint, tmp_path_factory):
    """Result of `benchmark.py realtime` with all parts, and the folder of its files."""
    folder = tmp_path_factory.mktemp("realtime")
    flags = ["--episodes", 1, "--rates", 50, "--device", "cpu", "--json", folder / "r.json", "--plot", folder / "r.png"]
    assert benchmark.main(["realtime", "--checkpoint", str(checkpoint), *map(str, flags)]) == 0
    return json.loads((folder / "r.json").read_text()), folder


def sleeper(milliseconds):
    """An agent that takes the given time for every decision."""

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


def test_realtime_measures_every_row_of_every_part(measured):
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


def test_part_table_has_one_line_per_row(measured):
    result, _ = measured
    for part in PARTS:
        assert len(part_table(part, result[part]).splitlines()) == 2 + len(result[part])


def test_measure_error_compares_the_model_with_no_change(measured):
    result, _ = measured
    for row in result["error"]:
        assert all(np.isfinite(row[name]) for name in ("latent_distance", "reward_error", "reward_change"))
    assert result["error"][0]["latent_change"] > 0.0


def test_realtime_measures_the_chosen_parts_only(tmp_path, checkpoint):
    path = tmp_path / "r.json"
    flags = ["--parts", "[error, error]", "--episodes", "1", "--device", "cpu", "--json", str(path)]
    assert benchmark.main(["realtime", "--checkpoint", str(checkpoint), *flags]) == 0
    result = json.loads(path.read_text())
    assert set(PARTS) & result.keys() == {"error"}
    assert [row["step"] for row in result["error"]] == list(range(1, 9))  # a part that is named twice is measured once


def test_errors_are_means_over_the_episodes_that_are_long_enough():
    short, long, none = np.full((8, 1, 4), 1.0), np.full((20, 3, 4), 5.0), np.zeros((0, 0, 4))
    assert mean_errors([short, long, none]) == [[4.0] * 4] * 8 + [[5.0] * 4] * 12
    assert mean_errors([none]) == []


def test_realtime_refuses_an_environment_that_cannot_run_on_before_it_plays(checkpoint, capsys, monkeypatch):
    monkeypatch.setattr("latentplan.envs.make_env", lambda _: SimpleNamespace(close=lambda: None))
    assert benchmark.main(["realtime", "--checkpoint", str(checkpoint), "--device", "cpu"]) == 2
    assert capsys.readouterr().err.endswith("give --parts iterations,error,replan\n")


def test_soak_and_realtime_show_an_agent_the_vectors_that_it_has_learned_to_see(save_agent, tmp_path, monkeypatch):
    monkeypatch.setattr("bench.soak.PAUSE_SECONDS", 0.0)
    agent = save_agent(tmp_path / "agent", Spaces(vector_dim=2), vectors=("velocity",))
    where = ["--checkpoint", str(agent), "--device", "cpu"]
    soak = ["--mode", "actor", "--control-hz", "200", "--decisions", "4", "--block", "2"]
    assert benchmark.main(["soak", *where, *soak]) == 0
    assert benchmark.main(["realtime", *where, "--parts", "error", "--episodes", "1"]) == 0


def test_soak_counts_every_agent_beside_an_idle_one(tmp_path, checkpoint, capsys, monkeypatch):
    monkeypatch.setattr("bench.soak.PAUSE_SECONDS", 0.0)
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


def test_play_block_counts_boundaries_missed_by_a_busy_agent():
    tally = Tally()
    play_block(sleeper(25.0), FRAMES, 100.0, 9, tally)  # two or more boundaries pass in each decision
    assert tally.due == 9
    assert tally.misses >= 6
    assert len(tally.decision_ms) + tally.misses == 9
    assert min(tally.decision_ms) >= 25.0


def test_play_block_counts_due_decisions_when_interrupted():
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


def test_take_turns_plays_one_block_of_each_agent_in_turn(monkeypatch):
    monkeypatch.setattr("bench.soak.PAUSE_SECONDS", 0.0)
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


def test_soak_rows_subtract_the_misses_of_the_idle_agent():
    tallies = {IDLE: Tally(1000, 1, [0.1], [0.2]), "actor": Tally(500, 2, [1.0], [0.2]), "gated": Tally()}
    rows = soak_rows(tallies)
    assert list(rows) == [IDLE, "actor"]
    assert rows["actor"]["misses_per_10000"] == pytest.approx(40.0)
    assert rows["actor"]["minus_no_op"] == pytest.approx(30.0)
    assert "+30.0" in soak_table(rows)
