"""The command line of environments by id: train, resume, evaluate, distil, list and test them."""

import json
import shutil
import sys

import cv2
import numpy as np
import pytest
import yaml

from latentplan.agents.checkpoint import read_info
from latentplan.commands.flags import read_request
from latentplan.commands.main import main
from latentplan.commands.train import Request, resolve
from latentplan.config.earlier import ADDED
from latentplan.config.env_id import by_id
from latentplan.config.run_folder import RUN_FILE
from latentplan.config.suites import SUITES, Suite
from latentplan.envs import by_id as by_id_module
from tests.envs import odd

MODULE = "tests.envs.odd"
STATE = f"{MODULE}:odd/State-v0"
RENDER = ("--env.pixels", "render")
SMALL = """
    --preset cpu --device cpu --run.threads 1 --frames 160 --collection.overlap false --evaluation.video false
    --model.deter_dim 8 --model.hidden_dim 8 --model.encoder_channels [4,4] --model.decoder_channels 2
    --model.num_bins 5 --planner.horizon 2 --planner.num_samples 8 --planner.num_elites 2 --planner.num_iterations 1
    --planner.num_policy_samples 2 --planner.warm_start_iterations 1 --learning.batch_size 4
    --learning.sequence_length 5 --learning.imagination_horizon 3 --learning.imagination_starts 8
    --collection.prefill_decisions 40
    --collection.round_decisions 20 --collection.updates_per_decision 0.2 --evaluation.episodes 1
    --evaluation.final_episodes 1 --evaluation.every_frames 80
""".split()


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run") / "run"
    kwargs = ("--env-kwargs", '{"brightness": 200}')
    assert main(["train", "--env-id", STATE, *RENDER, *kwargs, *SMALL, "--run-dir", str(folder)]) == 0
    return folder


def test_agent_remembers_id_and_arguments(trained):
    info = read_info(trained)
    assert (info["domain"], info["task"]) == ("gymnasium", STATE)
    env = info["config"]["env"]
    assert (env["suite"], env["kwargs"], env["pixels"]) == ("gymnasium", '{"brightness": 200}', "render")
    assert info["renderer"] == {"renderer": "the user's environment"}


def test_eval_plays_and_films_the_agent(trained, tmp_path):
    out = ("--json", str(tmp_path / "result.json"), "--video", str(tmp_path / "film.webm"))
    flags = ["--checkpoint", str(trained), "--mode", "actor", "--episodes", "1", "--device", "cpu", *out]
    assert main(["eval", *flags, "--env-id", STATE]) == 0
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["task"] == STATE and 0.0 <= result["mean_return"] <= 20.0
    shown, frame = cv2.VideoCapture(str(tmp_path / "film.webm")).read()
    assert shown and frame.max() > 150


def test_module_has_to_be_given_again(trained, assert_refused, monkeypatch):
    monkeypatch.delitem(sys.modules, MODULE)
    words = ("never imported", f"give --env-id {STATE}")
    assert_refused(["eval", "--checkpoint", trained, "--device", "cpu"], *words)
    assert_refused(["train", "--resume", trained], *words)
    assert_refused(["distill", "--checkpoint", trained, "--out", trained / "out", "--device", "cpu"], *words)
    assert MODULE not in sys.modules


def test_run_resumes_with_its_own_id_only(trained, assert_refused):
    assert_refused(
        ["train", "--resume", trained, "--env-id", "Slider-v0"], "is not the environment of", "gymnasium-" + STATE
    )
    assert main(["train", "--resume", str(trained), "--env-id", STATE, "--frames", "200"]) == 0
    assert read_info(trained / "checkpoints" / "last")["env_frames"] >= 200


def test_run_of_an_earlier_version_resumes_with_settings_that_have_no_effect(trained, tmp_path):
    folder = shutil.copytree(trained, tmp_path / "run")
    saved = yaml.safe_load((folder / RUN_FILE).read_text())
    saved["env"] |= ADDED["env"] | {"camera": 1}
    (folder / RUN_FILE).write_text(yaml.safe_dump(saved))
    with pytest.warns(RuntimeWarning, match="goes on with a change of env.camera from 0 to 1, env.render_slices from"):
        assert main(["train", "--resume", str(folder), "--env-id", STATE, "--frames", "240"]) == 0


def test_distill_plays_in_the_environment(trained, tmp_path, assert_refused):
    flags = ["--checkpoint", str(trained), "--out", str(tmp_path / "out"), "--device", "cpu"]
    assert_refused(["distill", *flags, "--env-id", "Slider-v0"], "another environment than", STATE)
    short = ["--rounds", "1", "--episodes", "1", "--evaluation-episodes", "2"]
    assert main(["distill", *flags, *short, "--updates", "2", "--env-id", STATE]) == 0
    assert read_info(tmp_path / "out")["task"] == STATE


def test_goals_refuses_an_agent_without_quantities(trained, tmp_path, assert_refused):
    assert_refused(["goals", "--checkpoint", trained, "--out", tmp_path / "out", "--device", "cpu"], "no goals")


def test_eval_refuses_environments_with_other_actions(checkpoint, assert_refused):
    two = f"{MODULE}:odd/TwoActions-v0"
    assert_refused(["eval", "--checkpoint", checkpoint, "--env-id", two], "takes actions of 2 numbers", "gives 1")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("TwoViews", "shows 2 cameras, the agent sees 1"),
        ("SixChoices", "takes actions of 6 categories, the agent gives continuous actions"),
    ],
)
@pytest.mark.parametrize("command", ["eval", "view"])
def test_environments_that_show_or_take_something_else_are_refused(command, name, words, checkpoint, assert_refused):
    flags = ["--port", "0"] if command == "view" else []
    line = [command, "--checkpoint", checkpoint, "--device", "cpu", "--env-id", f"{MODULE}:odd/{name}-v0", *flags]
    assert_refused(line, words, "give the environment that it learned in")


def test_eval_plays_an_agent_in_another_environment(checkpoint, tmp_path):
    flags = ["--checkpoint", str(checkpoint), "--mode", "actor", "--episodes", "1", "--device", "cpu"]
    assert main(["eval", *flags, "--env-id", f"{MODULE}:Slider-v0", "--json", str(tmp_path / "result.json")]) == 0
    assert json.loads((tmp_path / "result.json").read_text())["task"] == f"{MODULE}:Slider-v0"


def test_id_names_suite_domain_and_task():
    env = resolve(read_request(Request, ["--env-id", "Reacher-v5", "--preset", "cpu", "--env.action_repeat", "4"])).env
    assert {name: getattr(env, name) for name in ("suite", "domain", "task")} == by_id("Reacher-v5")
    assert env.action_repeat == 4


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("--env-id Reacher-v5 --domain walker", "--env-id and --domain cannot both be given"),
        ("--env-id Reacher-v5 --task walk", "--env-id and --task cannot both be given"),
        ("--env-id Reacher-v5 --env.suite dm_control", "--env-id and --env.suite cannot both be given"),
        ("--env-id Reacher-v5 --env-kwargs [1]", "kwargs must be a JSON object such as"),
        ("--env-id Reacher-v5 --env-kwargs {", "kwargs must be a JSON object such as"),
        ("--env-id Reacher-v5 --env.pixels video", "--env.pixels must be one of observation, render"),
        ("--env-id Reacher-v5 --env.objective speed", "Reacher-v5 returns its own reward"),
        ("--env-id Reacher-v5 --env.camera 1", "--env.camera has no effect in Reacher-v5"),
        ("--env-id Reacher-v5 --env.render_quality exact", "--env.render_quality has no effect in Reacher-v5"),
        ("--env-id Reacher-v5 --env.floor endless", "own arguments with --env-kwargs"),
        ("--env-id Reachr-v5", "unknown environment 'Reachr-v5'; did you mean 'Reacher-v5'"),
        ("--env-id no_robot:Reach-v0", "there is no module no_robot to import"),
        ("--env-id a:b:c", "--env-id must be an id"),
        ("--env-kwargs {}x", "kwargs must be a JSON object such as"),
        ('--env-kwargs {"a":1}', "--env-kwargs has no effect here: give --env-id too"),
        ("--domain walker --env.pixels render", "--env.pixels has no effect in walker"),
    ],
)
def test_train_and_check_env_refuse_bad_flags_in_one_line(line, expected, assert_refused):
    assert_refused(["train", "--frames", "100", *line.split()], expected)
    assert_refused(["check-env", *line.split()], expected)


def test_check_env_accepts_and_writes_a_strip(tmp_path, capsys):
    out = tmp_path / "strip.png"
    assert main(["check-env", STATE, *RENDER, "--decisions", "30", "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "training accepts this environment" in printed and "steps/s" in printed and "ms per frame" in printed
    strip = cv2.imread(str(out))
    assert strip.shape == (128, 8 * 128, 3) and len(np.unique(strip)) > 1


def test_check_env_refuses_a_strip_that_is_no_png(assert_refused):
    assert_refused(["check-env", STATE, "--out", "strip.jpg"], "--out must end in .png, got 'strip.jpg'")


def test_check_env_refuses_with_one_line_per_problem(capsys):
    assert main(["check-env", f"{MODULE}:odd/TwoProblems-v0"]) == 2
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 2 and all(line.startswith("error: ") for line in errors), errors


def test_envs_lists_every_suite_without_making_environments(capsys, monkeypatch):
    monkeypatch.setattr(by_id_module, "make_inner", None)
    assert main(["envs"]) == 0
    printed = capsys.readouterr().out
    assert "walker-walk" in printed and "InvertedPendulum-v5" in printed and "InvertedPendulum-v4" not in printed


def test_envs_describes_the_environments_of_a_suite(capsys, monkeypatch):
    monkeypatch.setitem(SUITES, "lamps", Suite("tests.envs.lamp_suite:make", {"lamp": ("bright",)}))
    assert main(["envs", "--suite", "lamps"]) == 0
    line = capsys.readouterr().out.strip()
    assert line.startswith("lamp-bright") and "uint8 (64, 64, 3)" in line and "float32 (1,) in [-1, 1]" in line


@pytest.mark.parametrize(
    ("name", "verdict"),
    [("Slider", "accepted"), ("odd/State", "accepted with --env.pixels render"), ("odd/TextActions", "not")],
)
def test_envs_says_what_training_accepts(name, verdict, capsys, monkeypatch):
    assert odd.Slider is not None
    monkeypatch.setattr("latentplan.commands.envs.list_ids", lambda: [f"{name}-v0"])
    assert main(["envs", "--suite", "gymnasium"]) == 0
    assert f"; {verdict}" in capsys.readouterr().out
