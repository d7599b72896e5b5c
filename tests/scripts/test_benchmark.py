import csv
import importlib
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from latentplan.agents.actor import ActorAgent
from latentplan.agents.checkpoint import save_checkpoint
from latentplan.agents.planning import PlanningAgent
from latentplan.commands.flags import list_flags
from latentplan.config import Config, EnvConfig, LearningConfig, ModelConfig, PlannerConfig, UserError
from latentplan.models import WorldModel

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))

import benchmark  # noqa: E402
from bench.ablate import compare_arms  # noqa: E402
from bench.arms import NAMES, Arm, Outcome, parse_arms  # noqa: E402
from bench.decide import measure_decisions  # noqa: E402
from bench.machine import product_limits  # noqa: E402
from bench.render import measure_qualities  # noqa: E402
from bench.report import format_table, interval, number  # noqa: E402
from bench.statistics import interquartile_estimate, interquartile_mean, paired_difference  # noqa: E402
from bench.update import PARTS, measure_graph, measure_update  # noqa: E402

ENV = EnvConfig(domain="cartpole", task="swingup", action_repeat=100, render_quality="fastest")
MODEL = ModelConfig(deter_dim=8, hidden_dim=8, encoder_channels=(4, 4), decoder_channels=2, num_bins=5)
PLANNER = PlannerConfig(
    horizon=3, num_samples=8, num_elites=2, num_policy_samples=2, num_iterations=4, warm_start_iterations=2
)
LEARNING = LearningConfig(batch_size=2, sequence_length=3, imagination_horizon=2, imagination_starts=4)
CONFIG = Config(env=ENV, model=MODEL, planner=PLANNER, learning=LEARNING)
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def model():
    torch.manual_seed(0)
    return WorldModel(MODEL, action_dim=1)


@pytest.fixture(scope="module")
def checkpoint(model, tmp_path_factory):
    """An untrained agent for ten-decision episodes of cartpole."""
    folder = tmp_path_factory.mktemp("agent")
    info = {"domain": "cartpole", "task": "swingup", "env_frames": 1234, "discount": 0.9, "metrics": {}}
    save_checkpoint(folder, model, CONFIG, info)
    return folder


def outcome(name, returns, share=None):
    return Outcome(Arm(name, "planner", {}), returns, [1.0] * len(returns), {"p50": 1, "p95": 1, "p99": 1}, share)


def ablated(tmp_path, checkpoint, arms, *flags):
    path = tmp_path / "result.json"
    command = ["ablate", "--checkpoint", checkpoint, "--arms", arms, "--device", "cpu", "--json", path, *flags]
    assert benchmark.main([str(word) for word in command]) == 0
    return json.loads(path.read_text())


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["trian"], "'train'"),
        (["train", "--update", "3"], "'--updates'"),
        (["train", "--updates", "0"], "--updates"),
        (["train", "--domain", "walkr"], "'walker'"),
        (["train", "--model.deter_dim", "x"], "model.deter_dim"),
        (["train", "--json", "no/such/folder/result.json"], "no/such/folder"),
        (["render", "--json", "/proc/result.json"], "cannot write in '/proc'"),
        (["ablate", "--checkpoint", ".", "--json", "one.file", "--csv", "./one.file"], "name the same file"),
        (["render", "--domains", ","], "--domains"),
        (["decide", "--checkpoint", ".", "--domain", "walker"], "--domain"),
        (["ablate"], "--checkpoint"),
        (["ablate", "--checkpoint", "no-such-folder"], "no-such-folder"),
        (["learn", "--tasks", "walkr-walk"], "'walker'"),
        (["learn", "--frames", "many"], "frames"),
        (["learn", "--seeds", "0,-1"], "--seeds"),
        (["learn", "--seeds", "0,one"], "--seeds must be whole numbers, separated by ',', got '0,one'"),
    ],
)
def test_main_refuses_bad_flags_in_one_line_that_names_the_flag(capsys, arguments, named):
    assert benchmark.main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("error: ")
    assert captured.err.count("\n") == 1
    assert named in captured.err


def test_help_lists_every_command_and_every_flag(capsys):
    assert benchmark.main([]) == 0
    overview = capsys.readouterr().out
    for name, command in benchmark.COMMANDS.items():
        assert f"  {name} " in overview and command.summary in overview
        assert benchmark.main([name, "--help-all"]) == 0
        text = capsys.readouterr().out
        for flag in list_flags(importlib.import_module(command.module).Request):
            assert f"  {flag.names[0]} " in text and flag.setting.meaning


def test_every_flag_of_the_benchmarks_keeps_its_default():
    found = {
        name: {
            flag.names[0]: flag.setting.default
            for flag in list_flags(importlib.import_module(command.module).Request)
            if "." not in flag.names[0]
        }
        for name, command in benchmark.COMMANDS.items()
    }
    assert found["train"].items() >= {"--updates": 20, "--domain": None, "--threads": None}.items()
    assert found["plan"].items() >= {"--samples": 500, "--horizon": 20, "--iterations": 5, "--plans": 30}.items()
    assert found["soak"].items() >= {"--control-hz": 50.0, "--decisions": 10_000, "--block": 250}.items()
    assert found["learn"].items() >= {"--seeds": (0, 1), "--thresholds": (250, 500, 750), "--mode": "planner"}.items()
    assert found["decide"].items() >= {"--batch": 1, "--decisions": 50, "--checkpoint": None}.items()


def test_tables_align_columns_and_show_what_is_missing():
    table = format_table(["arm", "return"], [["a", number(12.345)], ["longer", number(None)]])
    assert table.splitlines() == ["arm     return", "------  ------", "a         12.3", "longer       -"]
    assert interval((None, None)) == "-"
    assert interval((-1.0, 2.0), sign=True) == "-1.0 to +2.0"


def test_the_full_planner_comes_first_whether_named_or_not():
    assert [arm.name for arm in parse_arms("actor,cold", PLANNER)] == ["full", "actor", "cold"]
    assert [arm.name for arm in parse_arms("actor,full", PLANNER)] == ["full", "actor"]
    assert [arm.name for arm in parse_arms(",".join(NAMES), PLANNER)] == list(NAMES)


def test_own_arms_lay_typed_settings_over_the_planner():
    full, wide, actor, short = parse_arms("wide:init_std=1,num_iterations=6,actor,short:horizon=2", PLANNER)
    assert (full.planner, actor.mode, actor.planner) == ({}, "actor", {})
    assert wide == Arm("wide", "planner", {"init_std": 1.0, "num_iterations": 6})
    assert short == Arm("short", "planner", {"horizon": 2})


def test_parse_arms_no_actor_removes_every_use_of_the_actor():
    _, arm = parse_arms("no_actor", replace(PLANNER, tail="policy", surprise_limit=2.0))
    assert arm.planner == {"num_policy_samples": 0, "tail": "zero", "surprise_limit": None}


@pytest.mark.parametrize(
    "text", ["ful", "horizon=2", "actor,horizon=2", "w:horizn=2", "w:horizon=x", "w:horizon", "w:", "cold,cold", ":a=1"]
)
def test_arms_that_cannot_be_are_refused(text):
    with pytest.raises(UserError):
        parse_arms(text, PLANNER)


def test_pairing_removes_what_the_starts_share():
    starts = np.array([10.0, 500.0, 90.0, 300.0])
    shifted = paired_difference((starts + 7.0).tolist(), starts.tolist())
    assert shifted == pytest.approx((7.0, 7.0, 7.0))
    one, other = starts.tolist(), [40.0, 480.0, 100.0, 310.0]
    forward, backward = paired_difference(one, other), paired_difference(other, one)
    assert forward == pytest.approx((-backward.mean, -backward.high, -backward.low))


def test_a_single_pair_has_a_difference_but_no_interval():
    assert paired_difference([3.0], [1.0]) == (2.0, None, None)


def test_episodes_that_are_not_paired_are_refused():
    with pytest.raises(ValueError):
        paired_difference([1.0, 2.0], [1.0])


def test_the_interquartile_mean_ignores_the_outer_quarters():
    values = [0.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0]
    assert interquartile_mean(values) == interquartile_mean([*values[1:], -1e6]) == 6.5
    assert interquartile_mean([1.0, 3.0]) == 2.0


def test_the_bootstrap_resamples_within_each_task():
    apart = interquartile_estimate([[100.0, 100.0], [900.0, 900.0]])
    assert apart == (500.0, 500.0, 500.0)
    spread = interquartile_estimate([[1.0, 2.0, 3.0, 4.0]])
    assert spread.low < spread.mean == 2.5 < spread.high


def test_arms_are_compared_with_the_first():
    compared = compare_arms([outcome("full", [1.0, 2.0], 0.5), outcome("cold", [2.0, 4.0])])
    assert compared["full"]["minus_full"] is None
    assert compared["cold"]["minus_full"] == 1.5
    assert compared["full"]["differs_from_actor"] == 0.5


def test_an_update_is_measured_in_parts_whose_operations_add_up():
    measured = measure_update(CONFIG, action_dim=2, device=CPU, updates=2)
    assert set(measured["parts"]) == set(PARTS)
    assert sum(part["flop"] for part in measured["parts"].values()) == measured["flop"]
    assert all(measured["parts"][name]["flop"] > 0 for name in ("encode", "recurrence", "decode", "behaviour"))
    assert measured["frames_per_s"] == pytest.approx(8 * measured["updates_per_s"])
    assert measured["graph_ms"] is None and measure_graph(CONFIG, action_dim=2, device=CPU, updates=2) > 0.0
    assert measured["flop_per_s"] / product_limits(CPU, size=64)["float32"] > 0.0


def test_operations_grow_with_the_batch():
    small, large = (
        measure_update(replace(CONFIG, learning=replace(LEARNING, batch_size=size)), 1, CPU, 1)["parts"]
        for size in (2, 4)
    )
    for name in ("encode", "recurrence", "decode"):
        assert large[name]["flop"] == 2 * small[name]["flop"]


def test_model_steps_of_a_decision_are_those_of_a_warm_search(model):
    steps = measure_decisions(PlanningAgent(model, CONFIG, 0.9), batch=1, decisions=2)["model_steps"]
    assert steps == 3 * (2 * (8 - 2) + 2)  # horizon, times fresh candidates of two refits and the proposals
    assert measure_decisions(PlanningAgent(model, CONFIG, 0.9), batch=3, decisions=1)["model_steps"] == steps
    assert measure_decisions(ActorAgent(model, CONFIG), batch=1, decisions=2)["model_steps"] == 0


def test_compiled_models_are_timed_beside_themselves(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("torch.compile", lambda function, **_: function)
    path = tmp_path / "compile.json"
    sizes = ["--samples", "16", "--horizon", "3", "--iterations", "2", "--plans", "2"]
    assert benchmark.main(["compile", *sizes, "--json", str(path)]) == 0
    result = json.loads(path.read_text())
    assert "16 samples x 3 steps x 2 iterations" in capsys.readouterr().out
    for row in result["rows"]:
        assert row["ratio"] == pytest.approx(row["stepped_ms"] / row["compiled_ms"])
        assert row["largest_difference"] == 0.0 and row["stepped_ms"] > 0.0


def test_decide_leaves_planner_settings_to_the_command_line(tmp_path, checkpoint):
    path = tmp_path / "result.json"
    command = ["decide", "--checkpoint", checkpoint, "--decisions", 2, "--device", "cpu", "--json", path]
    assert benchmark.main([str(word) for word in [*command, "--planner.horizon", 1]]) == 0
    result = json.loads(path.read_text())
    assert result["planner"]["horizon"] == 1
    assert result["arms"]["planner"]["model_steps"] == 14
    assert result["arms"]["planner without actor"]["model_steps"] == 16


def test_qualities_are_compared_on_the_same_states():
    measured = measure_qualities(replace(ENV, action_repeat=1), num_frames=2)
    assert measured["exact"]["pixel_change"] == 0.0
    assert 0.0 < measured["fastest"]["pixel_change"] < 100.0
    assert all(facts["frame_ms"] > 0.0 for facts in measured.values())


def test_equal_arms_earn_the_same_in_every_episode(tmp_path, checkpoint):
    episodes = tmp_path / "episodes.csv"
    result = ablated(tmp_path, checkpoint, "actor,twin:horizon=3", "--episodes", 2, "--csv", episodes)
    full, twin, actor = (result["arms"][name] for name in ("full", "twin", "actor"))
    assert full["returns"] == twin["returns"]
    assert twin["minus_full_ci95"] == [0.0, 0.0]
    assert 0.0 <= full["differs_from_actor"] <= 1.0
    assert actor["differs_from_actor"] is None
    rows = list(csv.DictReader(episodes.open()))
    assert [row["arm"] for row in rows] == ["full", "full", "actor", "actor", "twin", "twin"]
    assert len({row["start_seed"] for row in rows}) == 2


def test_returns_do_not_depend_on_the_number_of_workers(tmp_path, checkpoint):
    alone, together = (
        ablated(tmp_path, checkpoint, "actor", "--episodes", 1, "--workers", workers)["arms"] for workers in (1, 2)
    )
    for name in ("full", "actor"):
        assert alone[name]["returns"] == together[name]["returns"]
