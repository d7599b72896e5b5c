"""Several workers share a run: the same results with every kind of worker, after kills, and after a resumption."""

import contextlib
import os
import signal
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from latentplan.config import CollectionConfig, Config, RunConfig, UserError
from latentplan.training import resume, saving, train
from latentplan.training.collection.crew import Crew, check_memory, end_episodes
from latentplan.training.collection.process import LocalWorker, RemoteWorker
from tests.training.dot import Dot
from tests.training.run_folder import fingerprint, read_rows, read_state

SETTINGS = {"evaluation": {"episodes": 3}}


def make_crew(config, dot, size):
    return Crew([RemoteWorker(config, dot, number=number) for number in range(size)], config.collection)


def collect(worker, counter, decisions=30):
    worker.submit("collect", None, "random", decisions, counter)
    return worker.result()


def weights_of(worker):
    return {name: value.numpy() for name, value in worker._collector.model.state_dict().items()}


def assert_same(one, other):
    for own, same in zip(one.rows, other.rows, strict=True):
        for name in ("frames", "actions", "rewards", "is_first"):
            np.testing.assert_array_equal(getattr(own, name), getattr(same, name))


@pytest.fixture(scope="module")
def pair(tiny, dot):
    """A crew of two, and its first two rounds."""
    crew = make_crew(tiny("", collection={"overlap": True, "workers": 2}), dot, 2)
    yield crew, [collect(crew, 0), collect(crew, 1)]
    crew.close()


def test_crew_divides_a_round_among_environments_of_their_own(pair):
    _, rounds = pair
    assert [part.decisions for part in rounds] == [30, 30]
    assert [len(rows.frames) for rows in rounds[0].rows] == [15, 15]
    assert not np.array_equal(rounds[0].rows[0].frames, rounds[0].rows[1].frames)


def test_first_worker_of_a_crew_collects_as_a_worker_alone(pair, tiny, dot):
    alone = LocalWorker(tiny(""), dot, "cpu")
    assert_same(replace(pair[1][0], rows=pair[1][0].rows[:1]), collect(alone, 0, 15))
    alone.close()


def test_crew_continues_from_the_memory_of_another(pair, tiny, dot):
    other = make_crew(tiny(""), dot, 2)
    other.submit("restore", pair[1][0].memory)
    assert other.result() is None
    assert_same(collect(other, 1), pair[1][1])
    other.close()


@pytest.mark.parametrize(
    ("collection", "num_envs", "fits"),
    [
        ({"workers": 2}, 1, True),
        ({"workers": 2, "backend": "ray"}, 1, True),
        ({"workers": 3}, 1, False),
        ({"workers": 2}, 2, False),
        ({}, 2, False),  # as many environments, but of one worker
        ({"overlap": False}, 2, False),
    ],
)
def test_memory_of_a_crew_fits_the_settings_of_the_same_workers_alone(pair, tiny, collection, num_envs, fits):
    config = tiny("", collection={"overlap": True, **collection}, env={"num_envs": num_envs})
    with contextlib.nullcontext() if fits else pytest.raises(UserError, match=r"collection\.workers.* no longer fit"):
        check_memory(pair[1][0].memory, config, Path("run"))


def test_memory_of_one_worker_fits_any_process_that_collects_alone(tiny, dot):
    alone = LocalWorker(tiny(""), dot, "cpu")
    memory = collect(alone, 0).memory
    alone.close()
    for collection in ({"overlap": True}, {"overlap": False}):
        check_memory(memory, tiny("", collection=collection), Path("run"))
    for collection in ({"overlap": True, "workers": 2}, {"overlap": True, "backend": "ray"}):
        with pytest.raises(UserError, match="no longer fit"):
            check_memory(memory, tiny("", collection=collection), Path("run"))
    check_memory(None, tiny("", env={"num_envs": 3}), Path("run"))


def test_crew_evaluates_as_one_worker_does(pair, tiny, dot):
    alone = LocalWorker(tiny(""), dot, "cpu")
    weights = weights_of(alone)
    for worker in (alone, pair[0]):
        worker.submit("evaluate", 5, None, weights)
    assert alone.result() == pair[0].result()
    alone.close()


def test_crew_replaces_a_process_that_was_killed_and_repeats_its_share(tiny, dot, pair):
    crew = make_crew(tiny(""), dot, 2)
    assert_same(collect(crew, 0), pair[1][0])
    os.kill(crew.members[1].worker._process.pid, signal.SIGKILL)
    with pytest.warns(RuntimeWarning, match=r"worker 1: .* started again \(1 of 20 times\), and repeats its round"):
        assert_same(collect(crew, 1), pair[1][1])
    assert crew.replaced == 1
    crew.close()


def test_end_episodes_leaves_a_memory_from_which_new_episodes_begin(pair, tiny, dot):
    memory = pair[1][0].memory["members"][0]
    worker = LocalWorker(tiny(""), dot, "cpu")
    worker.submit("restore", end_episodes(memory))
    worker.result()
    rows = collect(worker, 1, 5).rows[0]
    assert rows.is_first.tolist() == [True, False, False, False, False]
    worker.close()


class Slow(Dot):
    """An environment that takes its time in a process that the environment variable names."""

    def step(self, action):
        time.sleep(0.2 * (os.environ.get("SLOW_WORKER") == "yes"))
        return super().step(action)


def test_asynchronous_crew_does_not_wait_for_a_slow_worker(tiny, dot, monkeypatch):
    config = tiny("", collection={"overlap": True, "workers": 2, "asynchronous": True})
    alone = LocalWorker(config, dot, "cpu")
    weights = weights_of(alone)
    alone.close()
    fast = RemoteWorker(config, Slow, number=0)
    monkeypatch.setenv("SLOW_WORKER", "yes")
    crew = Crew([fast, RemoteWorker(config, Slow, number=1)], config.collection)
    assert [len(rows.frames) for rows in collect(crew, 0, 2).rows] == [1, 1]  # random decisions are shared evenly
    shares = []
    for counter in range(6):
        crew.submit("collect", weights, "actor", 8, counter)
        collected = crew.result()
        assert collected.decisions >= 8
        shares.append([len(rows.frames) for rows in collected.rows])
    assert shares[0][1] == 0 and sum(own for own, _ in shares) > sum(slow for _, slow in shares)
    assert collected.memory["shares"][0] > collected.memory["shares"][1]
    crew.close()


@pytest.fixture(scope="module")
def whole(tiny, dot, tmp_path_factory):
    """By number of workers, a run that nothing disturbed."""
    made = {}

    def make(workers):
        if workers not in made:
            made[workers] = tmp_path_factory.mktemp("whole") / "run"
            settings = {"overlap": True, "workers": workers}
            train(tiny(made[workers], collection=settings, **SETTINGS), dot)
        return made[workers]

    return make


@pytest.mark.slow
def test_run_with_one_worker_equals_a_run_that_collects_in_its_own_process(whole, tiny, dot, tmp_path):
    train(tiny(tmp_path / "run", **SETTINGS), dot)
    assert fingerprint(tmp_path / "run") == fingerprint(whole(1))


@pytest.mark.slow
@pytest.mark.parametrize("workers", [2, 3])
def test_run_with_several_workers_is_the_same_every_time(whole, tiny, dot, tmp_path, workers):
    settings = {"overlap": True, "workers": workers}
    run = train(tiny(tmp_path / "run", collection=settings, **SETTINGS), dot)
    assert fingerprint(run.run_dir) == fingerprint(whole(workers)) != fingerprint(whole(1))
    state = read_state(run.run_dir)
    assert state["run"]["env_frames"] >= 90 and len(state["memory"]["members"]) == workers


class Pausing(saving.Guard):
    """Interrupts a run in its second epoch."""

    def on_train_epoch_start(self, trainer, learner):
        if trainer.current_epoch == 1:
            os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.slow
def test_resumed_run_with_several_workers_equals_one_without_a_pause(whole, tiny, dot, tmp_path, monkeypatch):
    settings = {"overlap": True, "workers": 2}
    monkeypatch.setattr("latentplan.training.run.Guard", Pausing)
    assert train(tiny(tmp_path / "run", collection=settings, **SETTINGS), dot).exit_code == 130
    monkeypatch.undo()
    assert resume(tmp_path / "run", make_env=dot).exit_code == 0
    assert fingerprint(tmp_path / "run") == fingerprint(whole(2))


class Killing(saving.Guard):
    """Kills a worker after the first epoch, and another one before the final evaluation."""

    def on_train_epoch_end(self, trainer, learner):
        super().on_train_epoch_end(trainer, learner)
        if trainer.current_epoch == 0:
            self.kill(trainer, 1)

    def on_train_end(self, trainer, learner):
        self.kill(trainer, 0)

    def kill(self, trainer, number):
        os.kill(trainer.callbacks[1].worker.members[number].worker._process.pid, signal.SIGKILL)


@pytest.mark.slow
def test_run_whose_workers_are_killed_learns_the_same_weights(whole, tiny, dot, tmp_path, monkeypatch, recwarn):
    settings = {"overlap": True, "workers": 2}
    monkeypatch.setattr("latentplan.training.run.Guard", Killing)
    run = train(tiny(tmp_path / "run", collection=settings, **SETTINGS), dot)
    weights = [read_state(folder)["learner"]["weights"] for folder in (run.run_dir, whole(2))]
    assert all(torch.equal(value, weights[1][name]) for name, value in weights[0].items())
    assert {row.get("worker_restarts") for row in read_rows(run.run_dir)} >= {"1"}


@pytest.mark.slow
def test_asynchronous_run_says_that_its_results_depend_on_the_speed_of_workers(tiny, dot, tmp_path, capsys):
    settings = {"overlap": True, "workers": 2, "asynchronous": True}
    run = train(tiny(tmp_path / "run", collection=settings), dot)
    assert "workers     2 on this machine, asynchronous: the results depend on their speed" in capsys.readouterr().out
    assert run.exit_code == 0 and read_state(run.run_dir)["run"]["env_frames"] >= 90


@pytest.mark.parametrize(
    ("collection", "run", "message"),
    [
        ({"overlap": False, "workers": 2}, {}, "collection.overlap false collects in the learning process"),
        ({"overlap": False, "backend": "ray"}, {}, "collection.overlap false collects in the learning process"),
        ({"asynchronous": True}, {}, "collection.asynchronous has no effect with one worker"),
        ({}, {"ray_address": "10.0.0.1:6379"}, "run.ray_address has no effect here"),
    ],
)
def test_config_refuses_settings_of_workers_without_effect(collection, run, message):
    with pytest.raises(UserError, match=message):
        Config(collection=CollectionConfig(**collection), run=RunConfig(**run))


def test_config_refuses_a_number_of_workers_or_a_backend_that_does_not_exist():
    with pytest.raises(ValueError, match=r"workers must be in \[1, 256\], got 0"):
        CollectionConfig(workers=0)
    with pytest.raises(ValueError, match="backend must be one of process, ray, got 'dask'"):
        CollectionConfig(backend="dask")
