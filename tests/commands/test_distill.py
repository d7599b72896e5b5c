"""The command line of distillation: one line for every mistake, and an answer at once."""

import dataclasses
import json
import shutil

import numpy as np
import pytest
import torch

from latentplan.agents.checkpoint import read_info, save_checkpoint
from latentplan.commands import distill
from latentplan.commands.main import main
from latentplan.config import Config, DistillConfig, EnvConfig, ModelConfig, PlannerConfig
from latentplan.models import WorldModel

CONFIG = Config(
    env=EnvConfig(domain="cartpole", task="swingup", action_repeat=100, render_quality="fastest"),
    model=ModelConfig(deter_dim=8, hidden_dim=8, encoder_channels=(4, 4), decoder_channels=2, num_bins=5),
    planner=PlannerConfig(horizon=3, num_samples=8, num_elites=2, num_policy_samples=1, num_iterations=2),
)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    folder = tmp_path_factory.mktemp("agent")
    torch.manual_seed(0)
    info = {"domain": "cartpole", "task": "swingup", "env_frames": 1234, "discount": 0.9}
    save_checkpoint(folder, WorldModel(CONFIG.model, action_dim=1), CONFIG, info)
    return folder


def test_the_command_distils_and_resumes(checkpoint, tmp_path, capsys):
    out = tmp_path / "out"
    flags = ["--rounds", "1", "--episodes", "1", "--updates", "3", "--evaluation-episodes", "2", "--seed", "4"]
    command = ["distill", "--checkpoint", checkpoint, "--out", out, "--device", "cpu", *flags, "--planner.horizon", 2]
    assert main([str(word) for word in command]) == 0
    facts = read_info(out)["distilled"]
    assert (facts["rounds"], facts["decisions"], facts["planner"]["horizon"]) == (1, 10, 2)
    assert (facts["settings"]["updates"], facts["settings"]["seed"]) == (3, 4)
    assert distill.main(["--resume", str(out), "--rounds", "2", "--device", "cpu"]) == 0
    assert read_info(out)["distilled"]["rounds"] == 2
    printed = capsys.readouterr().out
    assert "round  1" in printed and "round  2" in printed and "95 % interval" in printed


@pytest.mark.parametrize("config", ["x", {"planner": {"horizons": 3}}])
def test_settings_that_cannot_be_read_are_one_line(checkpoint, tmp_path, capsys, config):
    folder = shutil.copytree(checkpoint, tmp_path / "agent")
    info = json.loads((folder / "info.json").read_text())
    (folder / "info.json").write_text(json.dumps({**info, "config": config}))
    assert distill.main(["--checkpoint", str(folder), "--out", str(tmp_path / "out"), "--planner.horizon", "3"]) == 2
    assert "has settings of another version" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        ((), ("--checkpoint",)),
        (("--checkpoint", "{checkpoint}", "--rouns", "3"), ("--rouns", "--rounds")),
        (("--checkpoint", "{checkpoint}", "--rounds", "0"), ("--rounds", "at least 1")),
        (("--checkpoint", "{checkpoint}", "--rounds", "1.5"), ("--rounds", "whole number", "'1.5'")),
        (("--checkpoint", "{checkpoint}", "--minutes", "nan"), ("--minutes", "number", "'nan'")),
        (("--checkpoint", "{checkpoint}", "--minutes", "-1"), ("--minutes", "above 0")),
        (("--checkpoint", "{checkpoint}", "--relabel-share", "2"), ("--relabel-share", "[0.0, 1.0]")),
        (("--checkpoint", "{checkpoint}", "--device", "cud"), ("'cud'", "'cuda'")),
        (("--checkpoint", "{checkpoint}", "--planner.horizon", "long"), ("planner.horizon", "'long'")),
        (("--checkpoint", "{checkpoint}", "--out", "{checkpoint}"), ("--out",)),
        (
            (
                "--checkpoint",
                "nothing",
            ),
            ("nothing",),
        ),
        (("--resume", "nothing"), ("nothing to resume in nothing",)),
        (("--resume", "nothing", "--episodes", "3"), ("--episodes", "--rounds")),
    ],
)
def test_mistakes_are_one_line(flags, words, checkpoint, capsys):
    assert distill.main([flag.format(checkpoint=checkpoint) for flag in flags]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("error: ") and captured.err.count("\n") == 1
    assert all(word in captured.err for word in words), captured.err


def test_every_setting_has_a_flag_of_its_type():
    fields = {field.name: field.default for field in dataclasses.fields(DistillConfig)}
    flags = [word for name in fields for word in (f"--{name.replace('_', '-')}", "1" if name != "updates" else "2e2")]
    flags[flags.index("--evaluation-episodes") + 1] = "3"
    settings = distill.parse_arguments(["--checkpoint", "x", *flags]).settings
    assert settings.keys() == fields.keys() and settings["updates"] == 200
    for name, default in fields.items():
        assert type(settings[name]) is type(default if default is not None else 1.0)
    assert np.isfinite(list(settings.values())).all()


def test_help_lists_the_flags_without_torch_or_simulator(run_python, root):
    code = (
        "import runpy, sys\n"
        f"sys.argv = [{str(root / 'scripts' / 'distill.py')!r}, '--help']\n"
        "try: runpy.run_path(sys.argv[0], run_name='__main__')\n"
        "except SystemExit as stop: print('code', stop.code)\n"
        "print('loaded', sorted({'torch', 'lightning', 'mujoco', 'gymnasium', 'numpy'} & set(sys.modules)))\n"
    )
    result = run_python("-c", code)
    assert "code 0" in result.stdout and "loaded []" in result.stdout, result.stderr
    for flag in ("--checkpoint", "--rounds", "--episodes", "--minutes", "--out", "--seed", "--resume", "--device"):
        assert f"  {flag} " in result.stdout
