import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from latentplan.agents.checkpoint import load_model, save_checkpoint
from latentplan.agents.random import RandomAgent
from latentplan.commands import evaluate, evaluation_request
from latentplan.config import USER_DOMAIN, Config, EnvConfig, ModelConfig, PlannerConfig, UserError
from latentplan.envs import make_env
from latentplan.evaluation import evaluate_agent
from latentplan.models import WorldModel

ENV = EnvConfig(domain="cartpole", task="swingup", action_repeat=100, render_quality="fastest")
MODEL = ModelConfig(deter_dim=8, hidden_dim=8, encoder_channels=(4, 4), decoder_channels=2, num_bins=5)
PLANNER = PlannerConfig(horizon=3, num_samples=8, num_elites=2, num_policy_samples=1, num_iterations=2)


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    """A run folder whose best checkpoint is an untrained agent for ten-decision episodes of cartpole."""
    folder = tmp_path_factory.mktemp("run")
    info = {"domain": "cartpole", "task": "swingup", "env_frames": 1234, "discount": 0.9, "metrics": {}}
    torch.manual_seed(0)
    model = WorldModel(MODEL, action_dim=1)
    save_checkpoint(folder / "checkpoints" / "best", model, Config(env=ENV, model=MODEL, planner=PLANNER), info)
    return folder


@pytest.fixture(scope="module")
def checkpoint(run_folder):
    return run_folder / "checkpoints" / "best"


def run(checkpoint, *flags):
    return evaluate.main(["--checkpoint", str(checkpoint), "--device", "cpu", *map(str, flags)])


def result_of(tmp_path, checkpoint, *flags):
    assert run(checkpoint, "--json", tmp_path / "result.json", *flags) == 0
    return json.loads((tmp_path / "result.json").read_text())


def error_line(capsys, *flags, code=2):
    assert evaluate.main([str(flag) for flag in flags]) == code
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("error: ")
    assert captured.err.count("\n") == 1
    return captured.err


@pytest.mark.parametrize("mode", ["planner", "gated", "background", "actor", "random"])
def test_results_hold_the_promised_keys(tmp_path, checkpoint, mode):
    result = result_of(tmp_path, checkpoint, "--mode", mode, "--episodes", 2, "--seed", 5)
    promised = {"domain", "task", "mode", "seed", "returns", "mean_return", "ci95", "decision_ms"}
    assert {*promised, "env_frames_trained"} <= result.keys()
    assert (result["domain"], result["task"], result["mode"], result["seed"]) == ("cartpole", "swingup", mode, 5)
    assert result["env_frames_trained"] == 1234
    assert len(result["returns"]) == result["episodes"] == 2
    assert result["mean_return"] == pytest.approx(np.mean(result["returns"]))
    assert result["ci95"][0] <= result["mean_return"] <= result["ci95"][1]
    assert 0 < result["decision_ms"]["p50"] <= result["decision_ms"]["p95"] <= result["decision_ms"]["p99"]
    sources, fraction = result["action_source"], result["planned_fraction"]
    assert sources.keys() == {"plan", "tail", "actor"} and sum(sources.values()) == 20
    assert fraction == (sources["plan"] + sources["tail"]) / 20
    if mode in ("planner", "actor", "random"):
        assert sources["plan" if mode == "planner" else "actor"] == 20
    elif mode == "gated":
        assert sources["plan"] >= 2 and sources["tail"] == 0  # an episode's first decision is planned


def test_the_same_call_gives_the_same_returns(tmp_path, checkpoint):
    first, second, other = (
        result_of(tmp_path, checkpoint, "--episodes", 1, "--seed", seed)["returns"] for seed in (0, 0, 1)
    )
    assert first == second != other


def test_more_episodes_leave_the_first_ones_as_they_were(tmp_path, checkpoint):
    one, two = (result_of(tmp_path, checkpoint, "--episodes", count)["returns"] for count in (1, 2))
    assert one == two[:1]


def test_a_run_folder_means_its_best_checkpoint(tmp_path, run_folder, checkpoint):
    flags = ("--episodes", 1, "--mode", "actor")
    assert result_of(tmp_path, run_folder, *flags)["returns"] == result_of(tmp_path, checkpoint, *flags)["returns"]


def test_planner_settings_replace_those_of_the_checkpoint(tmp_path, checkpoint):
    flags = ("--episodes", 1, "--planner.horizon", 1, "--planner.terminal_value", "false")
    planner = result_of(tmp_path, checkpoint, *flags)["planner"]
    assert (planner["horizon"], planner["terminal_value"], planner["num_samples"]) == (1, False, PLANNER.num_samples)


@pytest.mark.parametrize("mode", ["planner", "gated"])
def test_a_deadline_can_be_given(tmp_path, checkpoint, mode):
    result = result_of(tmp_path, checkpoint, "--episodes", 1, "--mode", mode, "--planner.deadline_ms", 5)
    assert result["planner"]["deadline_ms"] == 5.0


def test_a_gated_agent_plans_no_more_than_it_may(tmp_path, checkpoint):
    for budget, fraction in ((0, 0.1), (0.5, 0.5), (1, 1.0)):  # the first of ten is planned whatever is allowed
        result = result_of(tmp_path, checkpoint, "--episodes", 1, "--mode", "gated", "--planning-budget", budget)
        assert 0.1 <= result["planned_fraction"] <= fraction
        assert budget == 0.5 or result["planned_fraction"] == fraction


def test_mean_interval_and_latency_are_printed(capsys, checkpoint):
    assert run(checkpoint, "--episodes", 2, "--mode", "random") == 0
    out = capsys.readouterr().out
    for words in ("mean return", "95 % interval", "p50", "p95", "p99", "cartpole-swingup", "random"):
        assert words in out


@pytest.mark.parametrize("mode", ["planner", "random"])
def test_the_film_holds_every_decision_and_the_end(tmp_path, checkpoint, mode):
    path = tmp_path / "film.mp4"
    assert run(checkpoint, "--episodes", 2, "--mode", mode, "--video", path) == 0
    capture, count = cv2.VideoCapture(str(path)), 0
    while capture.grab():
        count += 1
    assert count == 11  # ten decisions and what they led to
    assert capture.get(cv2.CAP_PROP_FRAME_WIDTH) >= 2 * 256
    assert [entry.name for entry in tmp_path.iterdir()] == ["film.mp4"]


def test_filming_changes_no_return(tmp_path, checkpoint):
    plain = result_of(tmp_path, checkpoint, "--episodes", 1)
    filmed = result_of(tmp_path, checkpoint, "--episodes", 1, "--video", tmp_path / "film.mp4")
    assert plain["returns"] == filmed["returns"]


def test_evaluate_agent_pairs_agents_by_episode():
    env = make_env(ENV)
    try:
        first, again = (evaluate_agent(RandomAgent(1), env, seed=3, episodes=3) for _ in range(2))
    finally:
        env.close()
    assert first["returns"] == again["returns"]
    assert first["seed"] == 3


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (("--mode", "planer"), ("'planer'", "'planner'")),
        (("--device", "cud"), ("'cud'", "'cuda'")),
        (("--planner.horizn", "3"), ("--planner.horizn", "--planner.horizon")),
        (("--episods", "3"), ("--episods", "--episodes")),
        (("--episodes", "0"), ("--episodes", "at least 1", "'0'")),
        (("--episodes", "ten"), ("--episodes", "whole number", "'ten'")),
        (("--seed", "-1"), ("--seed", "at least 0")),
        (("--planner.deadline_ms", "0"), ("planner.deadline_ms", "above 0")),
        (("--planner.horizon", "long"), ("planner.horizon", "'long'")),
        (("--planner.num_elites", "9"), ("num_elites (9)", "num_samples (8)")),
        (("--mode", "actor", "--planner.horizon", "3"), ("--planner.horizon", "--mode planner")),
        (("--planning-budget", "0.5"), ("--planning-budget", "--mode gated")),
        (("--mode", "gated", "--planning-budget", "30%"), ("--planning-budget", "0 to 1", "'30%'")),
        (("--video", "film.avi"), (".mp4", "'film.avi'")),
        (("--json",), ("--json", "value")),
        (("--json", "a.mp4", "--video", f"../{Path.cwd().name}/a.mp4"), ("--video and --json", "same file")),
        (("--threads", "1000000000000"), ("--threads", "1 to 1024")),
        (("--objective", "1e200 * 1e200 * cart > 1"), ("1e+200 * 1e+200", "not finite")),
        (("--constraint", "cart < 1e308 * 1e308"), ("not finite",)),
    ],
)
def test_bad_flags_get_one_line_that_names_them(capsys, checkpoint, flags, words):
    line = error_line(capsys, "--checkpoint", checkpoint, *flags)
    assert all(word in line for word in words), line


def test_the_checkpoint_must_be_given(capsys):
    assert "--checkpoint" in error_line(capsys, "--episodes", "1")


def test_a_missing_checkpoint_is_told_what_there_is(capsys, checkpoint):
    line = error_line(capsys, "--checkpoint", checkpoint.with_name("bets"))
    assert "bets" in line
    assert str(checkpoint) in line


@pytest.mark.parametrize("foreign", ["empty", "unreadable", "another"])
def test_a_foreign_checkpoint_is_one_line(capsys, tmp_path, foreign):
    if foreign != "empty":
        (tmp_path / "weights.safetensors").write_bytes(b"no weights")
        (tmp_path / "info.json").write_text("{" if foreign == "unreadable" else '{"architectures": ["Bert"]}')
    assert str(tmp_path) in error_line(capsys, "--checkpoint", tmp_path)


def test_an_agent_of_the_users_own_environment_is_played_from_python(capsys, tmp_path, checkpoint):
    model, config, info = load_model(checkpoint)
    own = replace(config, env=replace(config.env, domain=USER_DOMAIN, task="Dot"))
    save_checkpoint(tmp_path / "own", model, own, info)
    assert "load_agent" in error_line(capsys, "--checkpoint", tmp_path / "own")


def test_a_search_that_finds_nothing_finite_is_told(capsys, checkpoint, monkeypatch):
    monkeypatch.setattr(WorldModel, "rollout", lambda self, state, actions: (actions[..., 0] * torch.nan, state))
    assert run(checkpoint, "--episodes", "1") == 0
    assert "at 10 decisions the search found nothing finite" in capsys.readouterr().err


@pytest.mark.parametrize("flags", [[], ["--control-hz", 1]])
def test_what_surprised_the_model_is_no_failed_search(capsys, tmp_path, checkpoint, flags):
    result = result_of(tmp_path, checkpoint, "--episodes", 1, "--planner.surprise_limit", 1e-9, *flags)
    assert result["surprised"] == result["action_source"]["actor"] == 10
    told = capsys.readouterr()
    assert "surprised    10 of 10 decisions" in told.out and told.err == ""
    assert "surprised" not in result_of(tmp_path, checkpoint, "--episodes", 1)


@pytest.mark.parametrize(("objective", "limit"), [("return", 1e-9), ("return; 5: 2", 1e-9), ("2", None)])
def test_the_result_tells_whether_surprise_was_heeded(tmp_path, checkpoint, objective, limit):
    flags = ["--episodes", 1, "--planner.surprise_limit", 1e-9, "--objective", objective]
    result = result_of(tmp_path, checkpoint, *flags)
    assert result["planner"]["surprise_limit"] == limit
    assert (result["surprised"] > 0) == (limit is not None)


def test_a_name_that_is_too_long_is_one_line(capsys, checkpoint):
    for flags in (["--checkpoint", "a" * 300], ["--checkpoint", checkpoint, "--json", "a" * 300]):
        assert "too long" in error_line(capsys, *flags)


@pytest.mark.parametrize("flag", ["--video", "--json"])
def test_output_paths_are_tried_before_anything_is_played(capsys, tmp_path, checkpoint, flag):
    name = {"--video": "film.mp4", "--json": "result.json"}[flag]
    line = error_line(capsys, "--checkpoint", checkpoint, flag, tmp_path / "no" / "where" / name)
    assert f"nearest that exists is '{tmp_path}'" in line
    (tmp_path / name).mkdir()
    assert "is a folder" in error_line(capsys, "--checkpoint", checkpoint, flag, tmp_path / name)


def test_a_result_goes_where_a_link_leads(tmp_path, checkpoint):
    (tmp_path / "link.json").symlink_to("target.json")
    assert run(checkpoint, "--episodes", 1, "--json", tmp_path / "link.json") == 0
    assert (tmp_path / "link.json").is_symlink()
    assert json.loads((tmp_path / "target.json").read_text())["episodes"] == 1


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    with pytest.raises(UserError, match="cannot write in '/proc'"):
        evaluation_request.parse_arguments(["--checkpoint", str(tmp_path), "--json", "/proc/result.json"])


def test_help_lists_the_flags_without_torch_or_simulator(run_python, root):
    code = (
        "import runpy, sys\n"
        "sys.argv = ['eval.py', '--help']\n"
        "try: runpy.run_path(sys.path.pop(), run_name='__main__')\n"
        "except SystemExit as stop: print('code', stop.code)\n"
        "print('loaded', sorted({'torch', 'lightning', 'mujoco', 'cv2', 'gymnasium', 'numpy'} & set(sys.modules)))\n"
    )
    script = root / "scripts" / "eval.py"
    result = run_python("-c", f"import sys; sys.path.append({str(script)!r})\n{code}")
    assert "code 0" in result.stdout, result.stderr
    assert "loaded []" in result.stdout
    for flag in (*evaluation_request.FLAGS, "--planner.horizon", "--planner.num_policy_samples"):
        assert flag in result.stdout


def test_an_interrupt_reports_what_was_measured(root, tmp_path, checkpoint):
    script, out = root / "scripts" / "eval.py", tmp_path / "result.json"
    command = [sys.executable, script, "--checkpoint", checkpoint, "--episodes", "100000", "--json", out]
    process = subprocess.Popen(
        [*map(str, command), "--device", "cpu", "--mode", "actor"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 60
    while "episode 2 " not in process.stdout.readline():
        assert process.poll() is None and time.monotonic() < deadline, process.stderr.read()
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate(timeout=30)
    assert process.returncode == 130, stderr
    assert "interrupted after" in stdout
    assert "mean return" in stdout
    assert "Traceback" not in stderr
    assert 2 <= json.loads(out.read_text())["episodes"] < 100000
