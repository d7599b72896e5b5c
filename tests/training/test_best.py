"""What a run keeps as its best agent."""

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
