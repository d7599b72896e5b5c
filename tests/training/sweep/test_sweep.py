"""A sweep by Ray Tune: it stops trials that fall behind, goes on after a signal, and names the best settings."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

pytest.importorskip("ray")
pytest.importorskip("optuna")

STUB = Path(__file__).with_name("stub_run.py")
DRIVER = f"""
import sys
from latentplan.commands.main import main
from latentplan.training.sweep.trials import Sweep
Sweep.__init__.__defaults__ = (({str(STUB)!r},),)
sys.exit(main(sys.argv[1:]))
"""
TRIALS = 12


def start(tmp_path):
    (tmp_path / "space.yaml").write_text("planner: {horizon: {low: 3, high: 8}, num_samples: [64, 128]}\n")
    words = ["sweep", "--space", tmp_path / "space.yaml", "--out", tmp_path / "out", "--trials", TRIALS, "--jobs", 2]
    command = [sys.executable, "-c", DRIVER, *map(str, words), "--frames", "90", "--device", "cpu"]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def trials(out):
    return {path.parent.name: json.loads(path.read_text()) for path in out.glob("*/trial.json")}


def in_the_midst(out):
    """Whether two trials have ended, and another has begun to learn."""
    ended = {path.parent for path in out.glob("*/final.json")}
    return len(ended) >= 2 and {path.parents[2] for path in out.glob("*/resume/*/frames")} - ended


@pytest.mark.slow
def test_sweep_that_was_stopped_goes_on_and_names_the_best_settings(tmp_path):
    out = tmp_path / "out"
    first = start(tmp_path)
    deadline = time.monotonic() + 120
    while not in_the_midst(out) and time.monotonic() < deadline:
        time.sleep(0.05)
    os.kill(first.pid, signal.SIGTERM)
    text = first.communicate(timeout=120)[0]
    begun = trials(out)
    assert first.returncode == 143 and "stopped; the same command goes on with the sweep" in text, text
    assert 2 <= len(begun) < TRIALS
    second = start(tmp_path)
    text = second.communicate(timeout=300)[0]
    assert second.returncode == 0, text
    after = trials(out)
    assert begun.items() <= after.items() and len(after) == TRIALS  # the trials are those of before, and more
    assert sorted(number for number, _ in after.values()) == list(range(1, TRIALS + 1))
    calls = {name: (out / name / "processes.txt").read_text().split() for name in after}
    assert all(words[0] == "--config" and set(words[1:]) <= {"--resume", "saved"} for words in calls.values())
    assert any(words.count("--resume") for words in calls.values())
    finished = {name: values for name, (_, values) in after.items() if (out / name / "final.json").exists()}
    best = max(values["planner.horizon"] for values in finished.values())
    assert yaml.safe_load((out / "best.yaml").read_text())["planner"]["horizon"] == best
    early = calls.keys() - finished.keys()
    assert early and all(calls[name][-1] == "saved" for name in early)  # some were stopped, and saved themselves
    table = [line.split() for line in text.splitlines() if line.split()[1:2] in (["finished"], ["stopped"])]
    assert len(table) == TRIALS


@pytest.mark.slow
def test_sweep_says_why_trials_failed_and_exits_with_1(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "broken").touch()
    process = start(tmp_path)
    text = process.communicate(timeout=300)[0]
    assert process.returncode == 1 and "failed: error: this run is broken" in text and "Traceback" not in text, text
