"""What a run keeps as its best agent."""

import numpy as np
import pytest
import torch

from latentplan.training import train
from latentplan.training.callbacks import Experience, Save
from latentplan.training.collector import Collector


def test_the_best_agent_is_the_one_that_was_judged(tiny, dot, tmp_path, monkeypatch):
    """Also where the next evaluation is asked for as soon as one is taken."""
    judged, kept = [], []

    def weights_of(model):
        return {name: value.clone() for name, value in model.state_dict().items()}

    def judge(collector, episodes, film=None, weights=None):
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
