"""`scripts/benchmark.py`: command line, statistics, tables, and the commands train, decide, render, compile, ablate."""

import csv
import importlib
import json
import math
import sys
from dataclasses import replace

import benchmark
import numpy as np
import pytest
import torch
from bench.ablate import compare_arms
from bench.ablation_arms import NAMES, Arm, Outcome, parse_arms
from bench.decide import ExportedActor, measure_decisions
from bench.estimates import interquartile_estimate, interquartile_mean, paired_difference
from bench.machine import product_limits
from bench.render import measure_qualities
from bench.report import format_interval, format_number, format_table, write_json
from bench.train import shares_of_limits
from bench.train_update import PARTS, measure_graph, measure_update
from bench.view import summarize

from latentplan.agents.actor import ActorAgent
from latentplan.agents.planning import PlanningAgent
from latentplan.commands.flags import list_flags
from latentplan.config import PlannerConfig, UserError
from latentplan.config.spaces import Spaces
from latentplan.models import WorldModel

CPU = torch.device("cpu")
PLANNER = PlannerConfig()


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
        (["search", "--device", "cuda"], "--device cuda"),
        (["saving", "--device", "cuda"], "--device cuda"),
        (["collect", "--device", "cuda"], "--device cuda"),
        (["hostile", "--only", "nosuchname"], "--only 'nosuchname' is part of no input's name"),
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


def test_benchmark_modules_do_not_shadow_the_standard_library(root):
    names = {path.stem for path in (root / "scripts" / "bench").iterdir()}
    assert not names & sys.stdlib_module_names


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
    assert found["suite"].items() >= {"--tasks": (), "--seeds": (), "--frames": 100_000, "--jobs": 1}.items()
    assert found["decide"].items() >= {"--batch": 1, "--decisions": 50, "--checkpoint": None}.items()


def test_format_table_aligns_columns_and_marks_missing_values():
    table = format_table(["arm", "return"], [["a", format_number(12.345)], ["longer", format_number(None)]])
    assert table.splitlines() == ["arm     return", "------  ------", "a         12.3", "longer       -"]
    assert format_interval((None, None)) == "-"
    assert format_interval((-1.0, 2.0), sign=True) == "-1.0 to +2.0"


@pytest.mark.parametrize("numbers", [(), (4,), (4, 4)])
def test_rate_of_the_view_needs_two_decisions(numbers):
    moments = [{"number": number, "late": 0, "decision_ms": 1.0, "busy_ms": 1.0, "at": 0.0} for number in numbers]
    with pytest.raises(UserError, match="no two decisions within --seconds"):
        summarize(moments)


def test_parse_arms_puts_the_full_planner_first():
    assert [arm.name for arm in parse_arms("actor,cold", PLANNER)] == ["full", "actor", "cold"]
    assert [arm.name for arm in parse_arms("actor,full", PLANNER)] == ["full", "actor"]
    assert [arm.name for arm in parse_arms(",".join(NAMES), PLANNER)] == list(NAMES)


def test_parse_arms_applies_settings_of_own_arms():
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
def test_parse_arms_refuses_invalid_arms(text):
    with pytest.raises(UserError):
        parse_arms(text, PLANNER)


def test_paired_difference_removes_the_effect_of_the_starts():
    starts = np.array([10.0, 500.0, 90.0, 300.0])
    shifted = paired_difference((starts + 7.0).tolist(), starts.tolist())
    assert shifted == pytest.approx((7.0, 7.0, 7.0))
    one, other = starts.tolist(), [40.0, 480.0, 100.0, 310.0]
    forward, backward = paired_difference(one, other), paired_difference(other, one)
    assert forward == pytest.approx((-backward.mean, -backward.high, -backward.low))


def test_paired_difference_has_no_interval_for_a_single_pair():
    assert paired_difference([3.0], [1.0]) == (2.0, None, None)


def test_paired_difference_refuses_lists_of_different_length():
    with pytest.raises(ValueError):
        paired_difference([1.0, 2.0], [1.0])


def test_interquartile_mean_ignores_the_outer_quarters():
    values = [0.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0]
    assert interquartile_mean(values) == interquartile_mean([*values[1:], -1e6]) == 6.5
    assert interquartile_mean([1.0, 3.0]) == 2.0


def test_interquartile_estimate_keeps_groups_apart():
    apart = interquartile_estimate([[100.0, 100.0], [900.0, 900.0]])
    assert apart == (500.0, 500.0, 500.0)
    spread = interquartile_estimate([[1.0, 2.0, 3.0, 4.0]])
    assert spread.low < spread.mean == 2.5 < spread.high
    resampled = interquartile_estimate([[100.0] * 5, [900.0] * 5])  # a bootstrap, because each group has five returns
    assert resampled == (500.0, 500.0, 500.0)


def test_compare_arms_compares_with_the_first_arm():
    compared = compare_arms([outcome("full", [1.0, 2.0], 0.5), outcome("cold", [2.0, 4.0])])
    assert compared["full"]["minus_full"] is None
    assert compared["cold"]["minus_full"] == 1.5
    assert compared["full"]["differs_from_actor"] == 0.5


@pytest.mark.parametrize("command", [["ablate", "--arms", "full"], ["zero-shot", "--constraints", "cart < 0.5"]])
def test_episodes_are_played_with_the_threads_that_were_asked_for(checkpoint, monkeypatch, command):
    used = []

    def play(*_, **__):
        used.append(torch.get_num_threads())
        raise UserError("seen")

    monkeypatch.setattr("latentplan.evaluation.episodes.run_episodes", play)
    before = torch.get_num_threads()
    try:
        for threads in ([], ["--threads", "3"]):
            assert benchmark.main([*command, "--checkpoint", str(checkpoint), "--device", "cpu", *threads]) == 2
    finally:
        torch.set_num_threads(before)
    assert used == [1, 3]


def test_measure_update_splits_an_update_into_parts_whose_operations_add_up(config):
    measured = measure_update(config, action_dim=1, device=CPU, updates=1)
    assert set(measured["parts"]) == set(PARTS)
    assert sum(part["flop"] for part in measured["parts"].values()) == measured["flop"]
    assert measured["parts"]["behaviour"]["flop"] > 0
    assert measured["frames_per_s"] == pytest.approx(8 * measured["updates_per_s"])
    assert measured["graph_ms"] is None and measure_graph(config, action_dim=1, device=CPU, updates=1) > 0.0
    assert measured["flop_per_s"] / product_limits(CPU, size=64)["float32"] > 0.0
    double = replace(config, learning=replace(config.learning, batch_size=2 * config.learning.batch_size))
    larger = measure_update(double, action_dim=1, device=CPU, updates=1)["parts"]
    for name in ("encode", "recurrence", "decode"):
        assert larger[name]["flop"] == 2 * measured["parts"][name]["flop"] > 0


def test_share_of_the_limit_is_that_of_the_threads_that_the_limit_was_measured_with():
    measured = {"flop": 100, "flop_per_s": 200.0, "in_turn_ms": 1000.0, "update_ms": 500.0}
    assert shares_of_limits(measured, {"float32": 100.0, "bfloat16": 400.0}) == {"float32": 1.0, "bfloat16": 0.25}


def test_json_has_null_where_a_number_is_not_finite(tmp_path):
    write_json(tmp_path / "result.json", {"ci95": (math.nan, 1.5), "rows": [{"cost": math.inf}]})
    assert json.loads((tmp_path / "result.json").read_text()) == {"ci95": [None, 1.5], "rows": [{"cost": None}]}


def test_measure_decisions_counts_the_model_steps_of_a_warm_search(config):
    torch.manual_seed(0)
    model = WorldModel(config.model, action_dim=1)
    steps = measure_decisions(PlanningAgent(model, config, 0.9), batch=1, decisions=2)["model_steps"]
    # The horizon, times fresh candidates of two refits, the proposals, which are imagined and then scored, and the plan
    # beside the policy's sequence.
    assert steps == 3 * (2 * (8 - 2) + 2 + 2 + 2)
    assert measure_decisions(PlanningAgent(model, config, 0.9), batch=3, decisions=1)["model_steps"] == steps
    assert measure_decisions(ActorAgent(model, config), batch=1, decisions=2)["model_steps"] == 0


@pytest.mark.parametrize("batch", [1, 3])
def test_measure_decisions_shows_frames_of_the_agents_own_shape(config, batch):
    model = WorldModel(config.model, action_dim=1, spaces=Spaces(frame_size=84, cameras=2))
    for agent in (actor := ActorAgent(model, config), ExportedActor(actor)):
        assert measure_decisions(agent, batch, decisions=1)["decision_ms"]["p50"] > 0.0


def test_decide_refuses_an_agent_that_sees_vectors_in_one_line(save_agent, tmp_path, capsys):
    save_agent(tmp_path, Spaces(vector_dim=2), vectors=("velocity",))
    assert benchmark.main(["decide", "--checkpoint", str(tmp_path), "--device", "cpu"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1 and "decide shows random pictures" in error


def test_compile_times_each_model_stepped_and_compiled(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("torch.compile", lambda function, **_: function)
    path = tmp_path / "compile.json"
    sizes = ["--samples", "16", "--horizon", "3", "--iterations", "2", "--plans", "2"]
    assert benchmark.main(["compile", *sizes, "--json", str(path)]) == 0
    result = json.loads(path.read_text())
    assert "16 samples x 3 steps x 2 iterations" in capsys.readouterr().out
    for row in result["rows"]:
        assert row["ratio"] == pytest.approx(row["stepped_ms"] / row["compiled_ms"])
        assert row["largest_difference"] == 0.0 and row["stepped_ms"] > 0.0


def test_decide_applies_planner_settings_of_the_command_line(tmp_path, checkpoint):
    path = tmp_path / "result.json"
    command = ["decide", "--checkpoint", checkpoint, "--decisions", 2, "--device", "cpu", "--json", path]
    assert benchmark.main([str(word) for word in [*command, "--planner.horizon", 1]]) == 0
    result = json.loads(path.read_text())
    assert result["planner"]["horizon"] == 1
    assert result["arms"]["planner"]["model_steps"] == 16 + 2  # candidates, and the imagination of the proposals
    assert result["arms"]["planner without actor"]["model_steps"] == 16
    assert result["arms"]["exported actor"]["model_steps"] == 0


def test_exported_actor_acts_like_the_agent(config):
    torch.manual_seed(0)
    model = WorldModel(config.model, action_dim=2)
    torch.nn.init.normal_(model.actor.mlp.output.weight, std=0.5)
    agent = ActorAgent(model, config)
    program, film = ExportedActor(agent), np.random.default_rng(0).integers(0, 256, (6, 64, 64, 3), dtype=np.uint8)
    for frames in (film, film.reshape(3, 2, 64, 64, 3)):
        for each in (agent, program):
            each.reset()
        for frame in frames:
            expected = agent.act(frame)
            assert np.ptp(expected) > 0.01
            np.testing.assert_allclose(program.act(frame), expected, atol=1e-4)


def test_measure_qualities_compares_the_same_states(config, monkeypatch):
    monkeypatch.setattr("bench.render.REPEATS", 1)
    measured = measure_qualities(replace(config.env, action_repeat=1), num_frames=1)
    assert measured["exact"]["pixel_change"] == 0.0
    assert 0.0 < measured["fastest"]["pixel_change"] < 100.0
    assert all(facts["frame_ms"] > 0.0 for facts in measured.values())


def test_ablate_gives_equal_arms_equal_returns(tmp_path, checkpoint):
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


@pytest.mark.usefixtures("_full_episodes")  # as in the workers
def test_ablate_returns_do_not_depend_on_the_number_of_workers(tmp_path, save_agent):
    checkpoint = save_agent(tmp_path / "agent", action_repeat=100)
    alone, together = (
        ablated(tmp_path, checkpoint, "actor", "--episodes", 1, "--workers", workers)["arms"] for workers in (1, 2)
    )
    for name in ("full", "actor"):
        assert alone[name]["returns"] == together[name]["returns"]


def test_train_against_a_commit_reports_the_ratio_of_both_trees(tmp_path, monkeypatch):
    monkeypatch.setattr("bench.against.ROUNDS", 1)
    speeds = {"tree": 2.0, "this": 3.0}
    measured = []

    def measure(tree, command, flags):
        measured.append((command, list(flags)))
        assert (tree / "scripts" / "benchmark.py").is_file()
        return {"updates_per_s": speeds["tree" if tree.name == "tree" else "this"]}

    monkeypatch.setattr("bench.against._measure", measure)
    flags = ["--learning.batch_size=2", "--learning.sequence_length=3", "--learning.imagination_starts=4"]
    flags += ["--learning.imagination_horizon=2", "--model.encoder_channels=[4, 4]", "--model.deter_dim=8"]
    always = ["--action-dim=1", "--updates=1", "--device=cpu", "--threads=1"]
    path = tmp_path / "result.json"
    assert benchmark.main(["train", *always, *flags, "--against", "HEAD", "--json", str(path)]) == 0
    compared = json.loads(path.read_text())["compare"]
    assert compared["ratio"] == 1.5 and len(compared["commit"]) == 40
    assert [(command, sorted(words)) for command, words in measured] == [("train", sorted(always + flags))] * 2


def test_train_refuses_an_unknown_commit_in_one_line(capsys):
    flags = ["--learning.batch_size=2", "--learning.sequence_length=3", "--model.deter_dim=8", "--updates=1"]
    assert benchmark.main(["train", "--action-dim=1", "--device=cpu", *flags, "--against", "no-such-commit"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "--against 'no-such-commit' is no commit of this checkout" in error
