"""Runs that are killed: the run that goes on equals one that was never killed."""

import os
import random
import shutil
import signal
import subprocess
import sys
import time

import pytest
import torch

from latentplan.config.run_folder import run_saves
from latentplan.training import resume, saving, train
from tests.training.run_folder import fingerprint, list_saves, read_rows, read_state

FRAMES = 120


@pytest.fixture(scope="module")
def toy(root):
    """The module of the toy runs that benchmarks disturb."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(root / "scripts"))
        from bench import toy

        return toy


@pytest.fixture(scope="module")
def whole(tiny, dot, tmp_path_factory):
    """The fingerprint of a run that nothing disturbed, and the seconds that it took."""
    folder, started = tmp_path_factory.mktemp("whole") / "run", time.monotonic()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(saving, "SAVE_MINUTES", 0.0)
        train(tiny(folder, run={"frames": FRAMES}), dot)
    return folder, time.monotonic() - started


def start(tiny, dot, folder, save_minutes=0.0, **changes):
    """Starts or continues a run in a forked process; returns its number."""
    child = os.fork()
    if child:
        return child
    code = 99
    try:
        torch.set_num_threads(1)
        log = os.open(f"{folder}.log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(log, 1), os.dup2(log, 2)
        saving.SAVE_MINUTES = save_minutes
        has_begun = (folder / "config.yaml").exists()
        config = tiny(folder, run={"frames": FRAMES}, **changes)
        code = (resume(folder, make_env=dot) if has_begun else train(config, dot)).exit_code
        sys.stdout.flush()
    finally:
        os._exit(code)


def end(child):
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def disturb(child, folder, number, rng, seconds):
    """Sends a signal at a random moment after the first save; returns the exit code."""
    deadline = time.monotonic() + 60.0
    while not list_saves(folder) and time.monotonic() < deadline:
        time.sleep(0.002)
    time.sleep(rng.uniform(0.0, seconds))
    os.kill(child, number)
    return end(child)


@pytest.mark.parametrize(
    ("number", "save_minutes"),
    [
        (signal.SIGKILL, 0.0),
        pytest.param(signal.SIGTERM, 5.0, marks=pytest.mark.slow),
        pytest.param(signal.SIGHUP, 0.0, marks=pytest.mark.slow),
        pytest.param(signal.SIGINT, 5.0, marks=pytest.mark.slow),
    ],
)
def test_resume_of_a_run_that_was_killed_equals_a_run_that_was_not(whole, tiny, dot, tmp_path, number, save_minutes):
    reference, seconds = whole
    rng, codes = random.Random(int(number)), []
    for _ in range(2):
        child = start(tiny, dot, tmp_path / "run", save_minutes)
        codes.append(disturb(child, tmp_path / "run", number, rng, seconds))
    assert end(start(tiny, dot, tmp_path / "run", save_minutes)) == 0
    assert set(codes) <= {0, 128 + number, -number}  # the last where the signal came before or after the run
    assert fingerprint(tmp_path / "run") == fingerprint(reference)
    assert [row["planner_return"] for row in read_rows(tmp_path / "run")] == [
        row["planner_return"] for row in read_rows(reference)
    ]
    assert "Traceback" not in (tmp_path / "run.log").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("lanes", [1, 2])
def test_run_whose_collection_process_is_killed_equals_a_run_without(tiny, dot, tmp_path, lanes, recwarn):
    killed, settings = [], {"env": {"num_envs": lanes}, "run": {"frames": 120}}

    class Killing(saving.Guard):
        """Kills the collection process after some epochs; its new one once more."""

        def on_train_epoch_end(self, trainer, learner):
            super().on_train_epoch_end(trainer, learner)
            worker = trainer.callbacks[1].worker
            if trainer.current_epoch in (0, 2):
                self.kill(worker)

        def on_train_end(self, trainer, learner):
            self.kill(trainer.callbacks[1].worker)  # before the final evaluation

        def kill(self, worker):
            killed.append(worker._process.pid)
            os.kill(worker._process.pid, signal.SIGKILL)

    train(tiny(tmp_path / "whole", **settings), dot)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("latentplan.training.run.Guard", Killing)
        run = train(tiny(tmp_path / "run", collection={"overlap": True}, **settings), dot)
    assert run.exit_code == 0 and len(set(killed)) == 3
    states = [read_state(tmp_path / name) for name in ("whole", "run")]
    assert states[1]["run"]["worker_restarts"] == 3
    weights = [state["learner"]["weights"] for state in states]
    assert all(torch.equal(value, weights[1][name]) for name, value in weights[0].items())
    assert states[0]["run"]["rounds"] == states[1]["run"]["rounds"]
    assert {row.get("worker_restarts") for row in read_rows(tmp_path / "run")} >= {"1", "2"}


def test_resume_warns_and_goes_on_when_the_newest_save_is_damaged(whole, dot, toy, tmp_path):
    reference, _ = whole
    shutil.copytree(reference, tmp_path / "run")
    toy.flip_bit(list_saves(tmp_path / "run")[-1] / "rows.pt", random.Random(0))
    with pytest.warns(RuntimeWarning, match=r"rows\.pt is damaged.*\(env frames \d+, .*is lost, and is done again"):
        resume(tmp_path / "run", make_env=dot)
    states = [read_state(folder)["learner"]["weights"] for folder in (reference, tmp_path / "run")]
    assert all(torch.equal(value, states[1][name]) for name, value in states[0].items())
    run_saves(tmp_path / "run").newest()


SECOND = """
import os, signal, sys
from tests.training.conftest import TINY
from tests.training.dot import Dot
from dataclasses import replace
from latentplan.training import train

class Deaf(Dot):
    count = 0
    def step(self, action):
        Deaf.count += 1
        if Deaf.count == 50:
            os.kill(os.getpid(), signal.SIGTERM)
            os.kill(os.getpid(), signal.SIGTERM)
            while True:
                pass
        return super().step(action)

train(replace(TINY, run=replace(TINY.run, run_dir=sys.argv[1])), Deaf)
"""


def test_second_signal_ends_the_process_at_once(tmp_path, root):
    environment = {**os.environ, "PYTHONPATH": str(root)}
    command = [sys.executable, "-c", SECOND, str(tmp_path / "run")]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    assert ended.returncode == 143 and "Traceback" not in ended.stderr


@pytest.mark.slow
def test_collection_process_ends_quietly_with_a_trainer_that_was_killed(tiny, dot, toy, tmp_path):
    folder = tmp_path / "run"
    child = start(tiny, dot, folder, collection={"overlap": True}, env={"num_envs": 2})
    deadline, workers = time.monotonic() + 60.0, []
    while (not list_saves(folder) or not workers) and time.monotonic() < deadline:
        workers = toy.list_children(child)
        workers += [other for worker in workers for other in toy.list_children(worker)]
        time.sleep(0.05)
    os.kill(child, signal.SIGKILL)
    end(child)
    deadline = time.monotonic() + 20.0
    while any(os.path.exists(f"/proc/{worker}") for worker in workers) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert workers and not any(os.path.exists(f"/proc/{worker}") for worker in workers)
    assert "Traceback" not in (tmp_path / "run.log").read_text()
