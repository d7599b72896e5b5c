"""Workers that are Ray actors: the same results as processes, and what is lost when an actor is killed."""

import contextlib
import os
import random
import signal
import socket
import sys
from types import SimpleNamespace

import pytest
import torch

from latentplan.commands.main import main
from latentplan.config import UserError, extras
from latentplan.training import saving, train
from latentplan.training.collection import ray_workers
from latentplan.training.collection.crew import make_worker
from tests.training.run_folder import fingerprint, read_rows, read_state

try:
    import ray
except ModuleNotFoundError:
    ray = None

needs_ray = pytest.mark.skipif(ray is None, reason="needs latentplan[ray]")
SETTINGS = {"evaluation": {"episodes": 3}}
KILLS = 20


def test_train_without_ray_says_what_to_install(monkeypatch, capsys):
    found = extras.util.find_spec
    monkeypatch.setattr(extras.util, "find_spec", lambda name: None if name == "ray" else found(name))
    assert main(["train", "--collection.backend", "ray", "--frames", "1000"]) == 2
    assert (
        capsys.readouterr()
        .err.splitlines()[-1]
        .endswith("collection.backend ray needs ray, which is not installed; run: pip install 'latentplan[ray]'")
    )


@needs_ray
@pytest.mark.parametrize("address", ["nowhere", "127.0.0.1:port"])
def test_join_cluster_refuses_an_address_that_is_none(tiny, dot, address):
    with pytest.raises(UserError, match="must be HOST:PORT, got"):
        make(tiny, dot, run={"ray_address": address})


@needs_ray
def test_join_cluster_refuses_an_address_where_nobody_answers(tiny, dot):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
        with pytest.raises(UserError, match=f"no Ray cluster answers at {address}: .*; start one with: ray start"):
            make(tiny, dot, run={"ray_address": address})


def test_worker_that_does_not_start_says_so_once(monkeypatch):
    monkeypatch.setattr(ray_workers, "PATIENCE_SECONDS", 0.0)
    looks = iter([[], [], [], ["started"]])
    worker = ray_workers.RayWorker.__new__(ray_workers.RayWorker)
    worker._ray = SimpleNamespace(wait=lambda asked, timeout: (next(looks), []))
    worker._started, worker._number, worker._should_stop = "started", 3, lambda: False
    with pytest.warns(RuntimeWarning, match="worker 3 has not started yet") as warned:
        worker._await_start()
    assert len(warned) == 1 and worker._started is None


def make(tiny, dot, workers=2, run=None, **collection):
    settings = {"overlap": True, "backend": "ray", "workers": workers, **collection}
    return make_worker(tiny("", collection=settings, run=run or {}), dot, torch.device("cpu"), lambda: False)


def collect(crew, counter):
    crew.submit("collect", None, "random", 30, counter)
    return crew.result()


def kill(crew, number):
    """Kills the process of an actor."""
    actor = crew.members[number].worker._actor
    os.kill(ray.get(actor.__ray_call__.remote(lambda _: os.getpid())), signal.SIGKILL)


@pytest.fixture
def cluster():
    """Ray ends after the test."""
    handler = signal.getsignal(signal.SIGTERM)
    yield
    ray.shutdown()
    assert signal.getsignal(signal.SIGTERM) == handler


@needs_ray
@pytest.mark.slow
def test_crew_of_actors_replaces_one_that_was_killed_and_cuts_its_episode_alone(tiny, dot, cluster):
    crew = make(tiny, dot, max_restarts=1)
    first = collect(crew, 0)
    assert [rows.is_first.sum() for rows in first.rows] == [1, 1] and first.memory["restarts"] == 0
    kill(crew, 1)
    with pytest.warns(RuntimeWarning, match=r"worker 1: .*\(1 of 1 times\), and its episode is cut short"):
        second = collect(crew, 1)
    assert [len(rows.frames) - rows.is_first.sum() for rows in second.rows] == [15, 14]  # one began before, one begins
    assert second.decisions == 30 and second.rows[1].is_first[0] and not second.rows[0].is_first[0]
    assert (second.memory["restarts"], crew.replaced) == (1, 1)
    kill(crew, 1)
    with pytest.raises(UserError, match=r"the Ray actor ended .* after 1 restarts \(collection.max_restarts 1\)"):
        collect(crew, 2)
    crew.close()


@needs_ray
@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2, 4])
def test_run_with_ray_learns_the_same_weights_as_one_with_processes(tiny, dot, tmp_path, workers, cluster):
    for backend in ("process", "ray"):
        settings = {"overlap": True, "workers": workers, "backend": backend}
        assert train(tiny(tmp_path / backend, collection=settings, **SETTINGS), dot).exit_code == 0
    one, other = (read_state(tmp_path / backend)["learner"]["weights"] for backend in ("process", "ray"))
    assert all(torch.equal(value, other[name]) for name, value in one.items())
    if workers > 1:  # a process alone has its memory in another form
        assert fingerprint(tmp_path / "ray") == fingerprint(tmp_path / "process")
    returns = [[row["planner_return"] for row in read_rows(tmp_path / backend)] for backend in ("process", "ray")]
    assert returns[0] == returns[1]


@needs_ray
@pytest.mark.slow
def test_run_whose_actors_are_killed_loses_nothing_but_their_episodes(tiny, dot, tmp_path, monkeypatch, cluster):
    rng, killed = random.Random(0), []

    class Killing(saving.Guard):
        def on_train_epoch_end(self, trainer, learner):
            super().on_train_epoch_end(trainer, learner)
            number = rng.randrange(2)
            if len(killed) < KILLS:
                with contextlib.suppress(ray.exceptions.RayActorError):  # killed before, and not missed yet
                    kill(trainer.callbacks[1].worker, number)
                    killed.append(number)

    monkeypatch.setattr("latentplan.training.run.Guard", Killing)
    settings = {"overlap": True, "workers": 2, "backend": "ray", "max_restarts": KILLS}
    with pytest.warns(RuntimeWarning, match="its episode is cut short"):
        run = train(tiny(tmp_path / "run", collection=settings, run={"frames": 600}, **SETTINGS), dot)
    state = read_state(run.run_dir)
    assert run.exit_code == 0 and len(killed) == KILLS
    assert state["run"]["env_frames"] >= 600 and state["run"]["decisions"] >= 600
    assert state["memory"]["restarts"] == sum(state["memory"]["ended"]) == state["run"]["worker_restarts"]
    assert 0.8 * KILLS <= state["run"]["worker_restarts"] <= KILLS  # one that is killed twice at once ends once
    assert read_rows(run.run_dir)[-1]["env_restarts"] or read_rows(run.run_dir)[-2]["env_restarts"]


@needs_ray
@pytest.mark.slow
def test_crew_goes_on_elsewhere_when_a_machine_of_the_cluster_ends(tiny, dot, monkeypatch):
    from ray.cluster_utils import Cluster

    handler = signal.getsignal(signal.SIGTERM)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(os.path.abspath(folder) for folder in sys.path))
    machines = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        lost = machines.add_node(num_cpus=1)
        with pytest.raises(UserError, match="the Ray cluster has 2 cores, too few for 3 workers"):
            make(tiny, dot, workers=3, run={"ray_address": machines.address})
        crew = make(tiny, dot, run={"ray_address": machines.address})
        collect(crew, 0)
        machines.remove_node(lost, allow_graceful=False)
        machines.add_node(num_cpus=1)
        with pytest.warns(RuntimeWarning, match="worker 1: .*its episode is cut short"):
            second = collect(crew, 1)
        assert second.decisions == 30 and second.memory["ended"] == [0, 1]
        crew.close()
    finally:
        ray.shutdown()
        machines.shutdown()
        signal.signal(signal.SIGTERM, handler)
