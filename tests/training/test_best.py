"""What a run keeps as its best agent."""

import numpy as np
import pytest
import torch

from latentplan.agents.checkpoint import read_info
from latentplan.training import resume, train
from latentplan.training.callbacks import Experience, Save, Stop
from latentplan.training.collection.collector import Collector
from latentplan.training.state import RunState


def test_the_best_agent_is_the_one_that_was_judged(tiny, dot, tmp_path, monkeypatch):
    """Also where the next evaluation is asked for as soon as one is taken."""
    judged, kept = [], []

    def weights_of(model):
        return {name: value.clone() for name, value in model.state_dict().items()}

    def judge(collector, episodes, film=None, weights=None, actor=True):
        if weights is not None:
            collector._load(weights)
        judged.append(weights_of(collector.model))
        return {"planner": [float(len(judged))], "actor": [0.0]}  # better each time

    def keep(save, name, model, info):
        if name == "best":
            kept.append(weights_of(model))

    monkeypatch.setattr(Collector, "evaluate", judge)
    monkeypatch.setattr(Save, "save_agent", keep)
    train(tiny(tmp_path / "run", evaluation={"every_frames": 15}), dot)
    assert len(kept) == len(judged) > 3
    for theirs, ours in zip(judged, kept, strict=True):
        assert all(torch.equal(theirs[name], ours[name]) for name in theirs)


@pytest.mark.parametrize(("again", "best"), [(3.0, "last"), (7.0, "early")])
def test_at_the_end_the_best_and_the_last_agent_meet_the_same_starts(tiny, dot, tmp_path, monkeypatch, again, best):
    """The best of many short evaluations is good by chance too."""
    returns = iter([10.0, 5.0, again, 5.0, again])  # an evaluation, then last and best at the end and when resumed

    def judge(collector, episodes, film=None, weights=None, actor=True):
        mean = next(returns)
        return {"planner": [mean] * episodes, "actor": [0.0] * episodes}

    monkeypatch.setattr(Collector, "evaluate", judge)
    first = train(tiny(tmp_path / "run", evaluation={"every_frames": 45}), dot)
    for run in (first, resume(first.run_dir, make_env=dot)):
        assert run.summary["planner"] == 5.0
        frames = {name: read_info(run.run_dir / "checkpoints" / name)["env_frames"] for name in ("best", "last")}
        assert (frames["last"], frames["best"]) == (90, {"last": 90, "early": 45}[best])


def test_who_is_only_compared_with_the_last_agent_plays_as_a_planner_alone(tiny, dot, tmp_path, monkeypatch):
    judged, evaluate = [], Collector.evaluate
    means = iter([10.0, 5.0, 7.0])  # an evaluation, then last and best at the end

    def judge(collector, episodes, *arguments):
        returns = evaluate(collector, episodes, *arguments)
        judged.append(tuple(returns))
        return returns | {"planner": [next(means)]}

    monkeypatch.setattr(Collector, "evaluate", judge)
    train(tiny(tmp_path / "run", evaluation={"every_frames": 45}), dot)
    assert judged == [("planner", "actor"), ("planner", "actor"), ("planner",)]


def test_an_evaluation_that_is_under_way_when_time_is_up_can_be_the_best(tiny, dot, tmp_path, monkeypatch):
    returns = iter([1.0, -1.0, 1.0])
    monkeypatch.setattr(Stop, "_is_late", lambda stop: stop.state.decisions >= 45)
    monkeypatch.setattr(Collector, "evaluate", lambda *_: {"planner": [next(returns)], "actor": [0.0]})
    run = train(tiny(tmp_path / "run"), dot)
    state = torch.load(run.run_dir / "resume" / "state.pt", weights_only=True)["run"]
    assert [entry["planner"] for entry in state["evaluations"]] == [1.0]
    assert read_info(run.run_dir / "checkpoints" / "best")["env_frames"] == 45


def test_a_signal_that_ends_the_process_that_collects_too_ends_the_run_in_order(tiny, tmp_path):
    class Gone:
        def result(self):
            raise RuntimeError("the process that collects has ended unexpectedly")

    state = RunState()
    experience = Experience(tiny(tmp_path), None, state, Gone(), tmp_path)
    experience._asked_round = True
    with pytest.raises(RuntimeError, match="ended unexpectedly"):
        experience.take()
    state.interrupted = True
    experience.take()
    assert not experience._asked_round


@pytest.mark.parametrize("rate", [0.01, 1.0])
def test_who_collects_is_the_average_of_the_latest_weights(tiny, dot, tmp_path, monkeypatch, rate):
    collected, is_latest, collect = [], [], Collector.collect
    start = Experience.on_train_epoch_start

    def equal(weights, model):
        return all(np.array_equal(weights[name], value.numpy()) for name, value in model.state_dict().items())

    def keep(collector, weights, *arguments):
        collected.append(weights)
        return collect(collector, weights, *arguments)

    def compare(experience, trainer, learner):
        before = len(collected)
        start(experience, trainer, learner)
        if len(collected) == before or collected[-1] is None:  # the last epoch learns from what there is
            return
        assert equal(collected[-1], learner.averaged)
        is_latest.append(equal(collected[-1], learner.model))

    monkeypatch.setattr(Collector, "collect", keep)
    monkeypatch.setattr(Experience, "on_train_epoch_start", compare)
    settings = {"evaluation": {"every_frames": 15}, "learning": {"average_rate": rate}}
    train(tiny(tmp_path / "run", **settings), dot)
    assert len(is_latest) > 2 and is_latest[0]  # before the first update there is nothing to average
    assert all(is_latest) if rate == 1.0 else not all(is_latest)
