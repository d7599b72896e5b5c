"""`latentplan distill` teaches an agent and resumes; errors of one line."""

import json
import shutil

import pytest
import yaml

from latentplan.agents.checkpoint import read_info
from latentplan.commands.main import main


def test_distill_teaches_an_agent_and_resumes(checkpoint, tmp_path, capsys):
    out = tmp_path / "out"
    flags = ["--rounds", "1", "--episodes", "1", "--updates", "3", "--evaluation-episodes", "2", "--seed", "4"]
    command = ["distill", "--checkpoint", checkpoint, "--out", out, "--device", "cpu", *flags, "--planner.horizon", 2]
    assert main([str(word) for word in command]) == 0
    assert "round  1" in capsys.readouterr().out
    facts = read_info(out)["distilled"]
    assert (facts["rounds"], facts["decisions"], facts["planner"]["horizon"]) == (1, 10, 2)
    assert (facts["settings"]["updates"], facts["settings"]["seed"]) == (3, 4)
    assert main(["distill", "--resume", str(out), "--rounds", "2", "--print-config"]) == 0
    shown = yaml.safe_load(capsys.readouterr().out)
    assert shown["settings"] == facts["settings"] | {"rounds": 2} and shown["planner"] == facts["planner"]
    for other in ("train", "goals"):
        assert main([other, "--resume", str(out)]) == 2
        assert f"{out} holds a distillation, not " in (line := capsys.readouterr().err)
        assert "continue it with latentplan distill --resume" in line
    assert main(["distill", "--resume", str(out), "--rounds", "2", "--device", "cpu"]) == 0
    assert read_info(out)["distilled"]["rounds"] == 2
    printed = capsys.readouterr().out
    assert "round  2" in printed and "95 % interval" in printed


@pytest.mark.parametrize("config", ["x", {"planner": {"horizons": 3}}])
def test_distill_refuses_settings_of_another_version(checkpoint, tmp_path, assert_refused, config):
    folder = shutil.copytree(checkpoint, tmp_path / "agent")
    info = json.loads((folder / "info.json").read_text())
    (folder / "info.json").write_text(json.dumps({**info, "config": config}))
    (folder / "manifest.json").unlink()
    flags = ["--checkpoint", folder, "--out", tmp_path / "out", "--planner.horizon", "3"]
    assert_refused(["distill", *flags], "has settings of another version")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        ((), ("--checkpoint",)),
        (("--checkpoint", "{checkpoint}", "--rouns", "3"), ("--rouns", "--rounds")),
        (("--checkpoint", "{checkpoint}", "--rounds", "0"), ("--rounds must be in [1, 1000000], got 0",)),
        (("--checkpoint", "{checkpoint}", "--rounds", "1.5"), ("--rounds", "whole number", "'1.5'")),
        (("--checkpoint", "{checkpoint}", "--minutes", "nan"), ("--minutes", "number", "'nan'")),
        (("--checkpoint", "{checkpoint}", "--minutes", "-1"), ("--minutes", "above 0")),
        (("--checkpoint", "{checkpoint}", "--relabel-share", "2"), ("--relabel-share", "[0.0, 1.0]")),
        (("--checkpoint", "{checkpoint}", "--device", "cud"), ("'cud'", "'cuda'")),
        (("--checkpoint", "{checkpoint}", "--planner.horizon", "long"), ("planner.horizon", "'long'")),
        (("--checkpoint", "{checkpoint}", "--out", "{checkpoint}"), ("--out",)),
        (("--checkpoint", "nothing"), ("nothing",)),
        (("--resume", "nothing"), ("nothing to resume in nothing",)),
        (("--resume", "nothing", "--minutes", "null"), ("--minutes cannot be null with --resume",)),
        (("--resume", "nothing", "--episodes", "3"), ("--episodes", "--rounds")),
    ],
)
def test_distill_refuses_bad_flags_in_one_line(flags, words, checkpoint, assert_refused):
    assert_refused(["distill", *(flag.format(checkpoint=checkpoint) for flag in flags)], *words)
