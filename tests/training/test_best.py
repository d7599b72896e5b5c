"""The agents that a run saves as best and last."""

import shutil

import numpy as np
import pytest
import torch

from latentplan.agents.checkpoint import read_info
from latentplan.replay.buffer import Replay
from latentplan.training import resume, train
from latentplan.training.callbacks import Collect
from latentplan.training.collection.collector import Collector
from latentplan.training.collection.episodes import Stopped
from latentplan.training.collection.process import RemoteWorker, WorkerEnded
from latentplan.training.saving import Save, Stop
from latentplan.training.state import RunState
from tests.training.run_folder import read_state


@pytest.fixture(scope="module")
def observed(tiny, dot, tmp_path_factory):
    """Weights that a run evaluated, saved as best and collected with; the next evaluation always follows at once."""
    evaluated, saved, collected = [], [], []
    collect, start = Collector.collect, Collect.on_train_epoch_start

    def copy_state(model):
        return {name: value.clone() for name, value in model.state_dict().items()}

    def evaluate(collector, episodes, film=None, weights=None, actor=True, record=False):
        if weights is not None:
            collector._load_weights(weights)
        evaluated.append(copy_state(collector.model))
        return {"planner": [float(len(evaluated))], "actor": [0.0]}  # every evaluation is better than the last

    def save_agent(save, name, model, info):
        if name == "best":
            saved.append(copy_state(model))

    def keep_weights(collector, weights, *arguments):
        collected.append((weights,))
        return collect(collector, weights, *arguments)

    def keep_models(callback, trainer, learner):
        before = len(collected)
        start(callback, trainer, learner)
        if len(collected) > before:
            collected[-1] += (copy_state(learner.averaged), copy_state(learner.model))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Collector, "evaluate", evaluate)
        patch.setattr(Collector, "collect", keep_weights)
        patch.setattr(Save, "save_agent", save_agent)
        patch.setattr(Collect, "on_train_epoch_start", keep_models)
        train(tiny(tmp_path_factory.mktemp("observed") / "run", evaluation={"every_frames": 15}), dot)
    return evaluated, saved, [entry for entry in collected if entry[0] is not None]


def test_best_agent_has_the_weights_that_were_evaluated(observed):
    evaluated, saved, _ = observed
    assert len(saved) == len(evaluated) > 3
    for theirs, ours in zip(evaluated, saved, strict=True):
        assert all(torch.equal(theirs[name], ours[name]) for name in theirs)


def test_collection_acts_with_the_averaged_weights(observed):
    _, _, collected = observed
    is_latest = []
    for weights, averaged, latest in collected:
        assert all(np.array_equal(weights[name], value.numpy()) for name, value in averaged.items())
        is_latest.append(all(np.array_equal(weights[name], value.numpy()) for name, value in latest.items()))
    assert len(is_latest) > 2 and is_latest[0]  # before the first update the average is the initial weights
    assert not all(is_latest)


def make_evaluate(returns, calls):
    """A stand-in for `Collector.evaluate` with given returns of the planner; records whether the actor plays."""

    def evaluate(collector, episodes, film=None, weights=None, actor=True, record=False):
        calls.append(actor)
        return {"planner": [next(returns)] * episodes, "actor": [0.0] * episodes}

    return evaluate


@pytest.fixture(scope="module")
def compared(tiny, dot, tmp_path_factory):
    """A run whose evaluation at 45 frames gave 10; at the end the last agent earns 5 and the best agent 7."""
    calls = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Collector, "evaluate", make_evaluate(iter([10.0, 5.0, 7.0]), calls))
        folder = tmp_path_factory.mktemp("compared") / "run"
        return train(tiny(folder, evaluation={"every_frames": 45}), dot), calls


def read_frames(folder):
    return {name: read_info(folder / "checkpoints" / name)["env_frames"] for name in ("best", "last")}


def test_best_agent_stays_when_it_beats_the_last_agent_on_the_final_starts(compared):
    run, _ = compared
    assert run.summary["planner"] == 5.0
    assert read_frames(run.run_dir) == {"best": 45, "last": 90}


def test_best_agent_is_replaced_when_the_last_agent_beats_it_on_the_final_starts(compared, dot, tmp_path, monkeypatch):
    """The best mean of many short evaluations is also high by chance, so the final evaluation repeats it."""
    folder = shutil.copytree(compared[0].run_dir, tmp_path / "run")
    monkeypatch.setattr(Collector, "evaluate", make_evaluate(iter([5.0, 3.0]), []))
    assert resume(folder, make_env=dot).summary["planner"] == 5.0
    assert read_frames(folder) == {"best": 90, "last": 90}


def test_best_agent_counts_when_its_last_commit_was_cut_off(compared, dot, tmp_path, monkeypatch):
    folder = shutil.copytree(compared[0].run_dir, tmp_path / "run")
    info = folder / "checkpoints" / "best" / "info.json"
    info.rename(info.with_name("info.json.part"))  # as after a crash between two renamings
    monkeypatch.setattr(Collector, "evaluate", make_evaluate(iter([5.0, 7.0]), []))
    assert resume(folder, make_env=dot).summary["planner"] == 5.0
    assert read_frames(folder) == {"best": 45, "last": 90}


def test_best_agent_is_evaluated_with_the_planner_only(compared):
    _, calls = compared
    assert calls == [True, True, False]  # an evaluation during the run, the last agent, the best agent


def test_evaluation_that_runs_when_the_time_is_up_can_be_the_best(tiny, dot, tmp_path, monkeypatch):
    monkeypatch.setattr(Stop, "_is_time_spent", lambda stop: stop.state.decisions >= 45)
    monkeypatch.setattr(Collector, "evaluate", make_evaluate(iter([1.0, -1.0, 1.0]), []))
    run = train(tiny(tmp_path / "run"), dot)
    assert [entry["planner"] for entry in read_state(run.run_dir)["run"]["evaluations"]] == [1.0]
    assert read_frames(run.run_dir)["best"] == 45


def test_store_results_keeps_requests_of_a_worker_that_ended_with_an_interrupted_run(tiny, tmp_path):
    class EndedWorker:
        def result(self):
            raise RuntimeError("collection failed")

    state, requests = RunState(), {"collect": {"decisions": 9, "counter": 3}, "evaluate": None, "weights": None}
    collect = Collect(tiny(tmp_path), None, state, EndedWorker(), tmp_path, requests)
    with pytest.raises(RuntimeError, match="collection failed"):
        collect.store_results()
    state.received = 15
    with pytest.raises(Stopped):
        collect.store_results()
    assert collect.requests["collect"] == {"decisions": 9, "counter": 3}  # the resumed run asks again


def empty_replay():
    return Replay(10, 1, 4, 1, torch.device("cpu"))


class Mortal(RemoteWorker):
    """A worker whose first three processes end while they are prepared."""

    def __init__(self):
        self.starts, self.asked = 0, []

    def restart(self):
        self.starts += 1

    def submit(self, *words):
        self.asked.append(words[0])

    def result(self):
        if self.starts < 3:
            raise WorkerEnded("the collection process ended unexpectedly (exit code -9)")


def test_replace_worker_starts_another_process_when_the_new_one_ends_too(tiny, tmp_path):
    state, requests = RunState(), {"collect": {"decisions": 9, "counter": 3}, "evaluate": None, "weights": None}
    collect = Collect(tiny(tmp_path), empty_replay(), state, Mortal(), tmp_path, requests, memory={"agent": "random"})
    with pytest.warns(RuntimeWarning, match="started again"):
        collect.replace_worker(WorkerEnded("ended"))
    assert state.worker_restarts == 3 and collect.worker.asked == ["restore"] * 3 + ["collect"]
    collect.worker.starts = -100  # from now on every process ends
    with pytest.warns(RuntimeWarning, match="20 of 20"), pytest.raises(WorkerEnded, match="unexpectedly"):
        collect.replace_worker(WorkerEnded("ended"))
    assert state.worker_restarts == 20


def test_replace_worker_counts_from_the_start_of_the_process(tiny, tmp_path):
    state, requests = RunState(worker_restarts=19), {"collect": None, "evaluate": None, "weights": None}
    collect = Collect(tiny(tmp_path), empty_replay(), state, Mortal(), tmp_path, requests, memory={"agent": "random"})
    with pytest.warns(RuntimeWarning, match=r"\(3 of 20 times\)"):
        collect.replace_worker(WorkerEnded("ended"))
    assert state.worker_restarts == 22
