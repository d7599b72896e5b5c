"""What a run keeps as its best agent."""

import numpy as np
import pytest
import torch

from latentplan.training import train
from latentplan.training.callbacks import Save
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
def test_rounds_are_collected_with_the_latest_weights_and_their_average_is_judged(
    tiny, dot, tmp_path, monkeypatch, rate
):
    latest, same, collect = [], [], Collector.collect

    def keep(collector, weights, *arguments):
        latest.append(weights)
        return collect(collector, weights, *arguments)

    def judge(collector, episodes, film=None, weights=None):
        same.append(all(np.array_equal(latest[-1][name], value) for name, value in weights.items()))
        return {"planner": [0.0], "actor": [0.0]}

    monkeypatch.setattr(Collector, "collect", keep)
    monkeypatch.setattr(Collector, "evaluate", judge)
    train(tiny(tmp_path / "run", evaluation={"every_frames": 15}, learning={"average_rate": rate}), dot)
    during = same[1:-1]  # before the first update there is nothing to average, and the last is not beside a round
    assert len(during) > 1 and (all(during) if rate == 1.0 else not any(during[1:]))
