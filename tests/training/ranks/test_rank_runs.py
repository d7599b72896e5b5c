"""Whole runs of two processes that Lightning starts, and their resumption with another number of processes."""

import csv
import os
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest
import torch

from latentplan.training import resume
from tests.training.run_folder import list_saves, read_state

FRAMES, MORE = 90, 120


def run_program(root, folder, devices, frames, **environment):
    """Trains or resumes in a process of its own; returns the exit code and what it printed."""
    own = {"PYTHONPATH": str(root), "OMP_NUM_THREADS": "1", **environment}
    command = [sys.executable, "-m", "tests.training.ranks.dots", str(folder), str(devices), str(frames)]
    ended = subprocess.run(command, cwd=root, env=os.environ | own, capture_output=True, text=True, timeout=540)
    assert "Traceback" not in ended.stderr, ended.stderr
    return ended.returncode, ended.stdout


@pytest.fixture(scope="module")
def pair(root, tmp_path_factory):
    """A finished run of two processes, and what it printed."""
    folder = tmp_path_factory.mktemp("pair") / "run"
    code, printed = run_program(root, folder, 2, FRAMES)
    assert code == 0
    return folder, printed


def read_saved_rows(folder):
    """Actions, rewards and sums of episodes of all processes, in one order; and the rows of each process."""
    files = sorted(list_saves(folder)[-1].glob("rows*.pt"))
    parts = [torch.load(file) for file in files]
    rows = torch.cat([torch.cat([part["actions"], part["rewards"][:, None]], 1) for part in parts]).numpy()
    return rows[np.lexsort(rows.T)], [len(part["rewards"]) for part in parts]


def contains(rows, others):
    """Whether all other rows are among the rows, as often."""
    counts = {}
    for row in map(bytes, np.ascontiguousarray(rows)):
        counts[row] = counts.get(row, 0) + 1
    for row in map(bytes, np.ascontiguousarray(others)):
        counts[row] = counts.get(row, 0) - 1
    return min(counts.values()) >= 0


def test_run_of_two_processes_counts_the_frames_of_both_and_keeps_both_replays(pair):
    folder, printed = pair
    state, (_, sizes) = read_state(folder), read_saved_rows(folder)
    assert state["run"]["env_frames"] == state["run"]["decisions"] == FRAMES
    assert len(sizes) == 2 and min(sizes) >= FRAMES // 2
    assert state["learner"]["updates"] == 24  # as one process makes from as many frames
    assert printed.count("task        ") == 1 and "2 share each batch of 4 (ddp)" in printed
    with (folder / "metrics.csv").open() as file:
        clocks = [int(row["updates"]) for row in csv.DictReader(file) if row["model_grad_norm"]]
    assert clocks == [6, 12, 18, 24]


def test_processes_collect_different_episodes(pair):
    parts = [torch.load(file)["actions"] for file in sorted(list_saves(pair[0])[-1].glob("rows*.pt"))]
    assert not torch.equal(*(part[:40] for part in parts))


def test_run_of_two_processes_resumes_with_one(pair, dot, tmp_path, capsys):
    folder = shutil.copytree(pair[0], tmp_path / "run")
    before, (rows, _) = read_state(folder), read_saved_rows(folder)
    result = resume(folder, frames=MORE, devices=1, make_env=dot)
    after, (more, sizes) = read_state(folder), read_saved_rows(folder)
    assert result.exit_code == 0 and set(result.summary) == {"planner", "actor"}
    assert capsys.readouterr().out.count("1 in place of 2: the rows of all replays are dealt anew") == 1
    assert len(sizes) == 1 and contains(more, rows)
    assert after["run"]["env_frames"] == MORE and after["run"]["decisions"] > before["run"]["decisions"]
    assert after["learner"]["updates"] > before["learner"]["updates"]
    assert {entry["step"].item() for entry in after["optimizers"][0]["state"].values()} == {after["learner"]["updates"]}
    resume(folder, frames=MORE + 15, make_env=dot)  # the number of processes is part of the settings


def test_run_of_one_process_resumes_with_two(root, finished, tmp_path):
    folder = shutil.copytree(finished.run_dir, tmp_path / "run")
    before, (rows, _) = read_state(folder), read_saved_rows(folder)
    code, printed = run_program(root, folder, 2, MORE)
    after, (more, sizes) = read_state(folder), read_saved_rows(folder)
    assert code == 0 and printed.count("2 in place of 1: the rows of all replays are dealt anew") == 1
    assert len(sizes) == 2 and contains(more, rows) and abs(sizes[0] - sizes[1]) <= 21  # an episode
    assert after["run"]["env_frames"] == MORE
    assert after["learner"]["updates"] > before["learner"]["updates"]


def equal_runs(folders):
    """Whether two runs have ended with the same weights and the same rows."""
    one, other = (read_state(folder)["learner"]["weights"] for folder in folders)
    rows = [read_saved_rows(folder)[0] for folder in folders]
    return all(torch.equal(value, other[name]) for name, value in one.items()) and np.array_equal(*rows)


@pytest.mark.parametrize("rank", [0, 1])
def test_both_processes_save_when_the_collection_of_one_ends_too_often(root, pair, tmp_path, rank):
    code, _ = run_program(root, tmp_path / "run", 2, FRAMES, ENDS_WITH=f"{rank}:4")
    before = read_state(tmp_path / "run")
    assert code == 2 and before["run"]["env_frames"] == 78
    assert run_program(root, tmp_path / "run", 2, FRAMES)[0] == 0
    assert equal_runs((pair[0], tmp_path / "run"))


@pytest.mark.slow
@pytest.mark.parametrize(("rank", "number"), [(0, signal.SIGTERM), (1, signal.SIGTERM), (1, signal.SIGKILL)])
def test_signal_to_one_process_ends_both_and_the_resumed_run_equals_one_without(root, pair, tmp_path, rank, number):
    code, printed = run_program(root, tmp_path / "run", 2, FRAMES, SIGNAL_AT=f"{rank}:36:{int(number)}")
    if number == signal.SIGTERM:
        assert code == 143 and printed.count("stopped; to resume") == 1
    else:
        assert code in (2, -signal.SIGKILL)  # the latter where Lightning kills the others first
    assert read_state(tmp_path / "run")["run"]["env_frames"] < FRAMES
    assert run_program(root, tmp_path / "run", 2, FRAMES)[0] == 0
    assert equal_runs((pair[0], tmp_path / "run"))
