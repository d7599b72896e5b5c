"""`latentplan eval` plays an agent, and prints, films and writes its results."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from latentplan.agents.checkpoint import load_model, save_checkpoint
from latentplan.agents.info import read_info
from latentplan.agents.random import RandomAgent
from latentplan.config import USER_DOMAIN
from latentplan.envs import make_env
from latentplan.evaluation import evaluate_agent, timed
from latentplan.models import WorldModel
from tests.commands.conftest import CONFIG, count_frames, result_of, run_eval


@pytest.fixture(scope="module")
def returns(checkpoint, tmp_path_factory):
    """Returns of two episodes that the agent plays with default settings."""
    return result_of(tmp_path_factory.mktemp("plain"), checkpoint, "--episodes", 2)["returns"]


@pytest.mark.parametrize("mode", ["planner", "gated", "background", "actor", "random"])
def test_eval_prints_and_writes_the_documented_results(tmp_path, checkpoint, mode, capsys):
    result = result_of(tmp_path, checkpoint, "--mode", mode, "--episodes", 2, "--seed", 5)
    documented = {"domain", "task", "mode", "seed", "returns", "mean_return", "ci95", "decision_ms"}
    assert {*documented, "env_frames_trained"} <= result.keys() and "surprised" not in result
    printed = capsys.readouterr().out
    for words in ("mean return", "95 % interval", "p50", "p95", "p99", "cartpole-swingup", mode):
        assert words in printed
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
        assert fraction <= 0.3  # the budget of a gated agent unless another is given


def test_returns_depend_on_seed_and_episode_alone(tmp_path, run_folder, returns):
    flags = ("--episodes", 1, "--threads", 1)  # a run folder stands for its best checkpoint
    film = tmp_path / "film.mp4"
    assert result_of(tmp_path, run_folder, *flags, "--video", film)["returns"] == returns[:1]
    assert result_of(tmp_path, run_folder, *flags, "--seed", 1)["returns"] != returns[:1]
    count, width = count_frames(film)
    assert count == 11 and width >= 2 * 256  # ten decisions and the last frame, beside the decoded end of the plan
    assert sorted(path.name for path in tmp_path.iterdir()) == ["film.mp4", "result.json"]


def test_film_of_an_agent_that_plans_nothing_holds_every_decision(tmp_path, checkpoint):
    assert run_eval(checkpoint, "--episodes", 1, "--mode", "random", "--video", tmp_path / "film.webm") == 0
    assert count_frames(tmp_path / "film.webm")[0] == 11


def test_planner_flags_replace_settings_of_the_checkpoint(tmp_path, checkpoint):
    flags = ("--planner.horizon", 1, "--planner.terminal_value", "false", "--planner.deadline_ms", 5)
    planner = result_of(tmp_path, checkpoint, "--episodes", 1, "--mode", "gated", *flags)["planner"]
    assert (planner["horizon"], planner["terminal_value"], planner["deadline_ms"]) == (1, False, 5.0)
    assert planner["num_samples"] == CONFIG.planner.num_samples


def test_gated_agent_plans_its_budget(tmp_path, checkpoint):
    for budget, fraction in ((0, 0.1), (1, 1.0)):  # the first of ten decisions is planned whatever the budget is
        result = result_of(tmp_path, checkpoint, "--episodes", 1, "--mode", "gated", "--planning-budget", budget)
        assert result["planned_fraction"] == fraction


def test_evaluate_agent_repeats_with_the_same_seed():
    env = make_env(CONFIG.env)
    try:
        first, again = (evaluate_agent(RandomAgent(1), env, seed=3, episodes=1) for _ in range(2))
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
        (("--episodes", "0"), ("--episodes must be in [1, 1000000], got 0",)),
        (("--episodes", "ten"), ("--episodes", "whole number", "'ten'")),
        (("--seed", "-1"), ("--seed", "at least 0")),
        (("--planner.deadline_ms", "0"), ("planner.deadline_ms", "above 0")),
        (("--planner.horizon", "long"), ("planner.horizon", "'long'")),
        (("--planner.num_elites", "9"), ("num_elites (9)", "num_samples (8)")),
        (("--mode", "actor", "--planner.horizon", "3"), ("--planner.horizon", "--mode planner")),
        (("--planning-budget", "0.5"), ("--planning-budget", "--mode gated")),
        (("--mode", "gated", "--planning-budget", "30%"), ("--planning-budget", "a finite number or null", "'30%'")),
        (("--video", "film.avi"), (".mp4", "'film.avi'")),
        (("--json",), ("--json", "value")),
        (("--json", "a.mp4", "--video", f"../{Path.cwd().name}/a.mp4"), ("--video and --json", "same file")),
        (("--mode", "gated", "--planning-budget", "1.5"), ("--planning-budget", "[0.0, 1.0]", "1.5")),
        (("--threads", "1000000000000"), ("--threads", "[1, 1024]")),
        (("--objective", "1e200 * 1e200 * cart > 1"), ("1e200 * 1e200", "too large for a number")),
        (("--constraint", "cart < 1e308 * 1e308"), ("too large for a number",)),
    ],
)
def test_eval_refuses_bad_flags_in_one_line(assert_refused, checkpoint, flags, words):
    assert_refused(["eval", "--checkpoint", checkpoint, *flags], *words)


@pytest.mark.parametrize(
    "flags", [("--constraint", "cart < 0.5"), ("--objective", "cart -> 0.5"), ("--control-hz", "20")]
)
def test_eval_keeps_no_episodes_of_another_world_or_aim(assert_refused, checkpoint, tmp_path, flags):
    kept = tmp_path / "kept"
    words = f"--keep-episodes cannot be given with {flags[0]}"
    assert_refused(["eval", "--checkpoint", checkpoint, "--keep-episodes", kept, *flags], words)
    assert not kept.exists()


def test_eval_names_its_own_flag_where_a_folder_holds_episodes(assert_refused, checkpoint, tmp_path):
    (tmp_path / "episode-000-000001.hdf5").touch()
    flags = ["--mode", "actor", "--device", "cpu", "--keep-episodes", tmp_path]
    assert_refused(["eval", "--checkpoint", checkpoint, *flags], "choose another folder", "(--keep-episodes)")


def test_eval_refuses_a_missing_checkpoint(assert_refused, checkpoint):
    assert_refused(["eval", "--episodes", "1"], "flag --checkpoint is missing; give the folder of a trained agent")
    assert_refused(["eval", "--checkpoint", checkpoint.with_name("bets")], "bets", checkpoint)


@pytest.mark.parametrize("foreign", ["empty", "unreadable", "another"])
def test_eval_refuses_a_foreign_checkpoint(assert_refused, tmp_path, foreign):
    if foreign != "empty":
        (tmp_path / "weights.safetensors").write_bytes(b"no weights")
        (tmp_path / "info.json").write_text("{" if foreign == "unreadable" else '{"architectures": ["Bert"]}')
    assert_refused(["eval", "--checkpoint", tmp_path], tmp_path)


@pytest.mark.parametrize("planner", [{"horizons": 3}, {"start": "policy"}, {"start": "shifted"}])
def test_eval_loads_settings_of_an_earlier_version_where_they_mean_the_same(
    assert_refused, tmp_path, checkpoint, planner
):
    shutil.copytree(checkpoint, tmp_path / "old")
    info = json.loads((checkpoint / "info.json").read_text())
    info["config"]["planner"].update(planner)
    (tmp_path / "old" / "manifest.json").unlink()  # which an earlier version did not write
    (tmp_path / "old" / "info.json").write_text(json.dumps(info))
    flags = ["--episodes", "1", "--mode", "random"]
    if planner == {"start": "shifted"}:
        assert run_eval(tmp_path / "old", *flags) == 0
    else:
        reason = "unknown setting planner.horizons" if "horizons" in planner else "a search starts from the shifted"
        assert_refused(["eval", "--checkpoint", tmp_path / "old", *flags], "settings of another version", reason)


def test_eval_refuses_an_agent_of_the_users_own_environment(assert_refused, tmp_path, checkpoint):
    model, config, info = load_model(checkpoint)
    own = replace(config, env=replace(config.env, domain=USER_DOMAIN, task="Dot"))
    save_checkpoint(tmp_path / "own", model, own, info)
    assert_refused(["eval", "--checkpoint", tmp_path / "own"], "load_agent")


def test_eval_warns_when_a_search_finds_nothing_finite(capsys, checkpoint, monkeypatch):
    monkeypatch.setattr(WorldModel, "rollout", lambda self, state, actions: (actions[..., 0] * torch.nan, state))
    assert run_eval(checkpoint, "--episodes", "1") == 0
    assert "at 10 decisions the search found nothing finite" in capsys.readouterr().err


@pytest.mark.parametrize("flags", [[], ["--control-hz", 1]])
def test_eval_reports_surprised_decisions_apart_from_failed_searches(capsys, tmp_path, checkpoint, flags):
    result = result_of(tmp_path, checkpoint, "--episodes", 1, "--planner.surprise_limit", 1e-9, *flags)
    assert result["surprised"] == result["action_source"]["actor"] == 10
    told = capsys.readouterr()
    assert "surprised    10 of 10 decisions" in told.out and told.err == ""


@pytest.mark.parametrize(("objective", "limit"), [("return", 1e-9), ("return; 5: 2", 1e-9), ("2", None)])
def test_result_names_the_surprise_limit_only_where_it_is_used(tmp_path, checkpoint, objective, limit):
    flags = ["--episodes", 1, "--planner.surprise_limit", 1e-9, "--objective", objective]
    result = result_of(tmp_path, checkpoint, *flags)
    assert result["planner"]["surprise_limit"] == limit
    assert (result["surprised"] > 0) == (limit is not None)


def test_eval_refuses_names_that_are_too_long(assert_refused, checkpoint):
    for flags in (["--checkpoint", "a" * 300], ["--checkpoint", checkpoint, "--json", "a" * 300]):
        assert_refused(["eval", *flags], "too long")


def test_eval_refuses_names_that_are_too_long_while_they_are_written(assert_refused, tmp_path, checkpoint):
    longest = 255  # bytes of a name; the file beside it has a longer one, by a number of one digit or several
    for flags in (["--json", tmp_path / ("a" * longest)], ["--report", tmp_path / f"{'a' * (longest - 5)}.html"]):
        assert_refused(["eval", "--checkpoint", checkpoint, *flags], "too long")
    assert list(tmp_path.iterdir()) == []


def test_eval_refuses_a_film_in_a_folder_whose_name_is_not_utf8(assert_refused, tmp_path, checkpoint, monkeypatch):
    folder = tmp_path / "\udcff"
    folder.mkdir()
    monkeypatch.chdir(folder)
    assert_refused(["eval", "--checkpoint", checkpoint, "--video", "film.webm"], "a film's path must be UTF-8")


def test_eval_ends_when_nobody_reads_its_output(root, checkpoint):
    command = [sys.executable, root / "scripts" / "eval.py", "--checkpoint", checkpoint, "--mode", "random"]
    command += ["--episodes", "3", "--device", "cpu"]
    process = subprocess.Popen([*map(str, command)], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.readline()
    process.stdout.close()
    complaint = process.stderr.read()
    assert (process.wait(), complaint) == (141, b"")


@pytest.mark.parametrize("flag", ["--video", "--json"])
def test_eval_tries_outputs_before_it_plays(assert_refused, tmp_path, checkpoint, flag):
    name = {"--video": "film.mp4", "--json": "result.json"}[flag]
    where = ["eval", "--checkpoint", checkpoint, flag]
    assert_refused([*where, tmp_path / "no" / "where" / name], flag, f"nearest that exists is '{tmp_path}'")
    (tmp_path / name).mkdir()
    assert_refused([*where, tmp_path / name], "is a folder")
    assert_refused([*where, f"/proc/{name}"], "cannot write in '/proc'")


def test_result_goes_where_a_link_leads(tmp_path, checkpoint):
    (tmp_path / "link.json").symlink_to("target.json")
    assert run_eval(checkpoint, "--episodes", 1, "--json", tmp_path / "link.json") == 0
    assert (tmp_path / "link.json").is_symlink()
    assert json.loads((tmp_path / "target.json").read_text())["episodes"] == 1


def test_interrupt_reports_the_finished_episodes(root, tmp_path, checkpoint):
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


def test_eval_writes_a_report_and_the_same_results_as_without(tmp_path, checkpoint, returns):
    page = tmp_path / "report.html"
    assert result_of(tmp_path, checkpoint, "--episodes", 2, "--report", page)["returns"] == returns
    text = page.read_text()
    assert all(f"<h2>{name}</h2>" in text for name in ("Film", "Returns", "Decision time", "Searches", "Provenance"))
    assert [path.name for path in tmp_path.glob("*.webm")] == []


def test_agent_that_is_replaced_while_it_is_loaded_is_refused(assert_refused, checkpoint, tmp_path, monkeypatch):
    agent = shutil.copytree(checkpoint, tmp_path / "agent")
    load = timed.load_timed_agent

    def replace_and_load(path, *settings, **changes):
        save_checkpoint(path, WorldModel(CONFIG.model, 1), CONFIG, read_info(checkpoint))  # other random weights
        return load(path, *settings, **changes)

    monkeypatch.setattr(timed, "load_timed_agent", replace_and_load)
    assert_refused(
        ["eval", "--checkpoint", agent, "--episodes", 1, "--device", "cpu"],
        f"the agent in {agent} was replaced meanwhile",
    )
