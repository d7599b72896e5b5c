"""benchmark.py survive and faults: what they cause happens, and what they count is true."""

import json
import random
import shutil
import sys
import tempfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "scripts"))

from bench import faults, survive  # noqa: E402
from bench.toy import Dot, take, toy_config  # noqa: E402

from latentplan.training import train  # noqa: E402


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A toy run of one evaluation."""
    folder = tmp_path_factory.mktemp("toy") / "run"
    return train(toy_config(folder, 60, overlap=False, every_frames=40), Dot).run_dir


def test_fingerprint_covers_weights_replay_and_metrics(run, tmp_path):
    same = shutil.copytree(run, tmp_path / "same")
    assert survive.fingerprint(same) == survive.fingerprint(run)
    for index, name in enumerate(("metrics.csv", "resume/logs/frames0-000000000000")):
        other = shutil.copytree(run, tmp_path / str(index))
        content = (other / name).read_bytes()
        (other / name).write_bytes(content[:-4] + b"0000")
        assert survive.fingerprint(other) != survive.fingerprint(run)


def test_is_noticed_is_false_for_files_that_are_whole(run):
    paths = [path for pattern in survive.FILES for path in run.glob(pattern)]
    assert len(paths) >= 15 and not any(survive.is_noticed(run, path) for path in paths)


def test_run_that_failed_is_kept_and_no_other_run_continues_it(tmp_path, monkeypatch):
    began = []

    def start(folder, *, overlap):
        began.append(folder.exists())
        folder.mkdir(parents=True)
        return 1

    for name, stub in {"_train": start, "_await_save": lambda *_: None, "_has_ended": lambda *_: True}.items():
        monkeypatch.setattr(survive, name, stub)
    monkeypatch.setattr(survive, "_wait", lambda _: 0)
    monkeypatch.setattr(survive, "fingerprint", lambda run: run.name)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    for is_worker in (False, True, False):
        row = survive.kill_runs(tmp_path / "runs", tmp_path / "reference", 1, 0.0, random.Random(0), is_worker)
        assert row == {"tries": 1, "survived": 0, "kills": 0}
    assert began == [False] * 3 and not list((tmp_path / "runs").iterdir())
    assert sorted(path.name for path in tmp_path.glob("survive-failed-*/*")) == ["trainer0", "trainer0", "worker0"]


@pytest.mark.slow
def test_survive_counts_tries_and_survivals(run_python, tmp_path):
    flags = "--trainer 1 --worker 0 --saves 3 --checkpoints 3 --flips 36 --decisions 0".split()
    done = run_python(ROOT / "scripts" / "benchmark.py", "survive", *flags, "--json", tmp_path / "result.json")
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "result.json").read_text())
    assert {name: (row["tries"], row["survived"]) for name, row in result.items() if row} == {
        "kill -9 of the trainer": (1, 1),
        "kill -9 of the worker": (0, 0),
        "kill -9 within a save": (3, 3),
        "kill -9 within a checkpoint": (3, 3),
        "flipped bits": (36, 36),
    }


@pytest.mark.soak
def test_faults_are_survived(run_python, tmp_path):
    flags = ("--minutes", 3, "--every", 5, "--log", tmp_path / "log", "--json", tmp_path / "result.json")
    done = run_python(ROOT / "scripts" / "benchmark.py", "faults", *flags, timeout=1200)
    assert done.returncode == 0, done.stdout
    assert "fault: " in (tmp_path / "log").read_text()


def test_take_removes_a_trigger_once(tmp_path):
    (tmp_path / "nan").touch()
    assert take(tmp_path / "nan") and not take(tmp_path / "nan")


def test_every_fault_has_a_tally_line():
    tallies = {name: faults.Tally(tries=1, survived=1, exit_codes=[137, 2, 137]) for name in faults.FAULTS}
    table = faults._format(tallies).splitlines()
    assert len(table) == 2 + len(faults.FAULTS) and table[2].endswith("2 137")
