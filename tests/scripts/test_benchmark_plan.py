"""`benchmark.py plan`: the project's planner beside planners of other libraries."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import benchmark
import pytest
import torch
from bench.peers import client, install
from bench.peers.client import PeerProcess
from bench.peers.install import PEERS, Peer, PeerError, last_line
from bench.peers.problem import Problem, as_state, build_model, next_features, rewards_at, start_state
from bench.plan import OURS, PLAIN, PRODUCTS, compare, summarise
from bench.plan_scaling import scaling_table
from bench.plan_searches import matrix_products, plain_search, planner_search, product_shapes
from torch.utils.flop_counter import FlopCounterMode

from latentplan.config import ModelConfig, to_dict
from latentplan.planning import check_model

MODEL = ModelConfig(
    deter_dim=8, hidden_dim=12, decoder_width=6, encoder_channels=(4, 4), decoder_channels=2, num_bins=5
)
PROBLEM = Problem(
    samples=20,
    horizon=3,
    iterations=2,
    action_dim=2,
    model=to_dict(MODEL),
    device="cpu",
    threads=torch.get_num_threads(),
)


def counted_flop(search):
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        search()
    return counter.get_total_flops()


def test_problem_survives_json():
    assert Problem.from_json(PROBLEM.to_json()) == PROBLEM
    assert PROBLEM.model_config == MODEL


def test_build_model_has_the_same_weights_in_both_precisions():
    full, half = (build_model(PROBLEM, dtype) for dtype in ("float32", "bfloat16"))
    for name, parameter in full.named_parameters():
        assert torch.equal(parameter, half.get_parameter(name))
    actions = torch.rand(30, PROBLEM.horizon, 2, generator=torch.Generator().manual_seed(0)) * 2 - 1
    start = as_state(full, start_state(PROBLEM).features.expand(30, -1))
    with torch.no_grad():
        (exact, last), (rounded, _) = (model.rollout(start, actions) for model in (full, half))
    assert last.deter.dtype == exact.dtype == torch.float32
    assert torch.corrcoef(torch.stack([exact.sum(1), rounded.sum(1)]))[0, 1] > 0.99  # five bins are coarse
    assert not torch.equal(exact, rounded)


def test_build_model_rollout_equals_its_steps_in_float32():
    check_model(build_model(PROBLEM, "float32"), start_state(PROBLEM, 3), 2)


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_next_features_and_rewards_at_equal_the_step_of_the_model(dtype):
    model, start = build_model(PROBLEM, dtype), start_state(PROBLEM, 4)
    action = torch.linspace(-1, 1, 8).reshape(4, 2)
    with torch.no_grad():
        following, reward = model.step(start, action)
        features = next_features(model, start.features, action)
        assert torch.equal(features, following.features)
        assert torch.equal(rewards_at(model, features), reward)


def test_build_model_rewards_differ_between_states():
    with torch.no_grad():
        returns = rewards_at(build_model(PROBLEM, "float32"), start_state(PROBLEM, 1).features + torch.rand(9, 40))
    assert returns.std() > 0.01


def test_matrix_products_equal_a_search_without_the_std_of_the_prior():
    products = counted_flop(matrix_products(PROBLEM, "float32"))
    assert products == PROBLEM.iterations * sum(2 * m * k * n for m, k, n in product_shapes(PROBLEM))
    std = 2 * PROBLEM.iterations * PROBLEM.horizon * PROBLEM.samples * MODEL.hidden_dim * MODEL.latent_dim
    assert counted_flop(plain_search(PROBLEM)) == products + std
    assert products <= counted_flop(planner_search(PROBLEM, "float32")) <= products + std


def test_planner_search_multiplies_its_operations_by_the_batch():
    assert counted_flop(planner_search(PROBLEM, "float32", 3)) == 3 * counted_flop(planner_search(PROBLEM, "float32"))


def test_searches_find_actions_of_high_reward():
    problem = replace(PROBLEM, samples=200, iterations=6, horizon=1)
    model, start = build_model(problem, "float32"), start_state(problem)
    random = torch.rand(1000, 2, generator=torch.Generator().manual_seed(0)) * 2 - 1
    with torch.no_grad():
        torch.manual_seed(0)
        found = torch.stack([plain_search(problem)(), planner_search(problem, "float32")().action[0]])
        actions = torch.cat([found.clamp(-1, 1), random])
        _, rewards = model.step(as_state(model, start.features.expand(len(actions), -1)), actions)
    assert rewards[:2].min() > rewards[2:].quantile(0.95)


def test_summarise_compares_the_fastest_of_each_side():
    times = {
        (OURS, "float32"): [30.0, 30.0, 30.0],
        (OURS, "bfloat16"): [10.0, 9.0, 50.0],
        (PLAIN, "float32"): [1.0],
        (PRODUCTS, "float32"): [20.0],
        (PRODUCTS, "bfloat16"): [5.0],
        ("one", "float32"): [40.0],
        ("one", "bfloat16"): [25.0],
        ("other", "float32"): [35.0],
        ("other", "bfloat16"): [28.0],
    }
    result = summarise(times, threads=2)
    assert result["ratio_fastest_peer"] == 3.5
    assert result["ratio_fastest_peer_same_dtype"] == 2.5
    assert result["ratio_matrix_limit"] == 2.0
    assert {row["planner"] for row in result["rows"]} == {OURS, PLAIN, "one", "other"}
    assert result["rows"][0] == {
        **{"planner": OURS, "dtype": "float32", "threads": 2},
        **{"p50_ms": 30.0, "p95_ms": 30.0, "p99_ms": 30.0},
    }


def test_plan_reports_limits_and_scaling_but_no_ratios_when_there_are_no_peers(tmp_path, capsys):
    json_path, plot = tmp_path / "plan.json", tmp_path / "growth.png"
    flags = "--peers none --samples 8 --horizon 2 --iterations 1 --plans 2 --action-dim 2 --device cpu"
    sizes = "--model.deter_dim 8 --model.hidden_dim 8 --model.num_bins 5"
    command = ["plan", *flags.split(), *sizes.split(), "--json", str(json_path), "--scaling", str(plot)]
    assert benchmark.main(command) == 0
    result = json.loads(json_path.read_text())
    assert result["ratio_fastest_peer"] is None
    assert result["ratio_fastest_peer_same_dtype"] is None
    assert result["ratio_matrix_limit"] > 0
    assert [(row["planner"], row["dtype"]) for row in result["rows"]] == [
        (OURS, "float32"),
        (OURS, "bfloat16"),
        (PLAIN, "float32"),
    ]
    assert {row["axis"] for row in result["scaling"]} == {"samples", "horizon", "iterations", "environments"}
    assert plot.stat().st_size > 0
    assert scaling_table(result["scaling"]) in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--peers", "torchlr"], "'torchrl'"),
        (["--peers", ","], "--peers"),
        (["--samples", "1"], "--samples"),
        (["--scaling", "no/such/folder/growth.png"], "no/such/folder"),
        (["--model.deter_dim", "x"], "model.deter_dim"),
    ],
)
def test_main_refuses_bad_flags_in_one_line_that_names_the_flag(capsys, arguments, named):
    assert benchmark.main(["plan", *arguments]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert named in captured.err


def test_compare_names_and_leaves_out_a_peer_that_cannot_be_installed(tmp_path, capsys):
    no_folder = tmp_path / "file"
    no_folder.write_text("in the way of an environment")
    measured = compare(PROBLEM, ["mbrl"], plans=1, folder=no_folder)
    assert list(measured.left_out) == ["mbrl"]
    assert measured.versions == {}
    assert all(len(laps) == 1 for laps in measured.times.values())
    assert re.search(r"^mbrl left out: .*; to install it: \S+ -m pip install .* mbrl ", capsys.readouterr().out, re.M)


def test_install_skips_an_installed_peer(tmp_path, monkeypatch):
    monkeypatch.setattr(install, "_call", lambda command: pytest.fail(f"called {command}"))
    receipt = "\n".join(PEERS["mbrl"].all_requirements)
    (tmp_path / "mbrl.installed").write_text(receipt)
    assert install.install("mbrl", tmp_path) == tmp_path / "bin" / "python"


def test_peer_process_answers_until_it_fails(tmp_path, monkeypatch):
    lines = [
        "from bench.peers.serve import serve",
        "from bench.plan_searches import plain_search",
        "def make_search(problem, model):",
        "    print('libraries talk')",
        "    if type(model).__name__ == 'WorldModel': raise RuntimeError('no half precision here')",
        "    return plain_search(problem)",
        "serve(make_search)",
    ]
    (tmp_path / "adapter.py").write_text("\n".join(lines))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setitem(PEERS, "own", Peer("adapter", "torch", ()))
    monkeypatch.setattr(client, "install", lambda name, folder: Path(sys.executable))
    process = PeerProcess("own", PROBLEM, tmp_path)
    try:
        assert process.search_ms("float32") > 0.0
        assert process.search_ms("float32") > 0.0
        for _ in range(2):
            with pytest.raises(PeerError, match="no half precision here"):
                process.search_ms("bfloat16")
    finally:
        process.close()


def test_last_line_prefers_a_line_about_an_error():
    assert last_line("WARNING: slow\nERROR: no such package\n\nnotice: a new pip\n") == "ERROR: no such package"
    assert last_line("first\nlast\n\n") == "last"
    assert last_line("") == ""
