"""The learner: model and behaviour learn at the same time, with the results of learning one after the other."""

import gc
from pathlib import Path

import pytest
import torch

from latentplan.models import WorldModel
from latentplan.models.fast import accelerate
from latentplan.replay.buffer import Replay
from latentplan.training.learner.module import Learner
from latentplan.training.state import restore_learner


class Standalone(Learner):
    """A learner with its own optimizers, which updates without a Trainer."""

    def optimizers(self, use_pl_optimizer=True):
        self.__dict__.setdefault("own", self.configure_optimizers())
        return self.own


def make_standalone(tiny, **learning):
    torch.manual_seed(0)
    config = tiny("", learning=learning)
    model = accelerate(WorldModel(config.model, action_dim=1))
    return Standalone(model, config.learning, 0.9, Replay(24, 1, 16, 1, torch.device("cpu")), seed=0)


def test_learner_gives_the_same_results_side_by_side_as_in_turn(batch, tiny):
    overlapped, in_turn = make_standalone(tiny), make_standalone(tiny)
    for _ in range(4):
        overlapped.training_step(batch, 0)
        in_turn.training_step(batch, 0)
        in_turn.catch_up()
    overlapped.catch_up()
    weights, expected = overlapped.model.state_dict(), in_turn.model.state_dict()
    assert all(torch.equal(weights[name], expected[name]) for name in expected)
    assert overlapped.metrics.keys() == in_turn.metrics.keys() >= {"actor", "reconstruction"}


def test_update_changes_model_then_behaviour_and_refreshes_the_snapshot(batch, tiny):
    learner = make_standalone(tiny)
    before = {name: value.clone() for name, value in learner.model.state_dict().items()}
    learner.training_step(batch, 0)
    moved = {name for name, value in learner.model.state_dict().items() if not torch.equal(value, before[name])}
    assert any(name.startswith("dynamics") for name in moved)
    assert not any(name.startswith(("actor", "value_head")) for name in moved)
    learner.catch_up()
    assert not torch.equal(learner.model.actor.mlp.output.weight, before["actor.mlp.output.weight"])
    frozen, own = learner.snapshot.model, learner.model
    dtype = own.backend.frozen_dtype(own)
    assert torch.equal(frozen.dynamics.gates.weight, own.dynamics.gates.weight.to(dtype))
    assert torch.equal(frozen.reward_head.mlp.output.weight, own.reward_head.mlp.output.weight)
    assert frozen.actor is own.actor and not frozen.dynamics.gates.weight.requires_grad


def test_an_update_leaves_no_reference_cycle(batch, tiny):
    """A cycle would keep the tensors of its update until Python looks for cycles among all objects, which is seldom."""
    learner = make_standalone(tiny)
    learner.training_step(batch, 0)
    learner.catch_up()
    gc.collect()
    gc.disable()
    try:
        for _ in range(3):
            learner.training_step(batch, 0)
            learner.catch_up()
        assert gc.collect() == 0
    finally:
        gc.enable()


def test_catch_up_raises_the_error_of_the_behaviour_thread(batch, tiny):
    learner = make_standalone(tiny)
    learner.training_step(batch, 0)
    learner.target_value = None
    with pytest.raises(AttributeError, match="NoneType"):
        learner.catch_up()


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_update_does_not_store_beliefs_of_turned_sequences(batch, tiny, share):
    learner = make_standalone(tiny, turned_share=share)
    learner.training_step(batch, 0)
    assert (learner.replay.deter[batch.rows] == 0.0).all() == (share == 1.0)


def test_reset_value_head_changes_only_the_value_head_and_its_optimizer_state(batch, tiny):
    learner = make_standalone(tiny)
    for _ in range(3):
        learner.training_step(batch, 0)
        learner.catch_up()
    before = {name: value.clone() for name, value in learner.model.state_dict().items()}
    learner.reset_value_head()
    fresh = learner.model.value_head.mlp.output.bias.clone()
    assert torch.equal(learner.averaged.value_head.mlp.output.bias, fresh)
    changed = {name for name, value in learner.model.state_dict().items() if not torch.equal(value, before[name])}
    assert changed and all(name.startswith("value_head") for name in changed)
    twin = learner.model.value_head.state_dict()
    assert all(torch.equal(value, twin[name]) for name, value in learner.target_value.state_dict().items())
    held = set(learner.optimizers()[1].state)
    assert held == set(learner.model.actor.parameters())
    assert learner.model.value_head.mean(learner.model.value_head(torch.ones(1, 48))).abs() < 1e-3
    learner.training_step(batch, 0)
    learner.catch_up()
    assert set(learner.optimizers()[1].state) > held


def collect_averages(learner, batch, updates):
    """Makes updates; returns learned and averaged weights after each update, oldest first."""
    seen = []
    for _ in range(updates):
        learner.training_step(batch, 0)
        learner.catch_up()
        seen.append(
            [{name: value.clone() for name, value in m.state_dict().items()} for m in (learner.model, learner.averaged)]
        )
    return seen


def test_averaged_weights_follow_the_documented_average(batch, tiny):
    seen = collect_averages(make_standalone(tiny, average_rate=0.4), batch, 30)
    for name in ("dynamics.gates.weight", "actor.mlp.output.weight", "value_head.mlp.output.bias"):
        weights, averages = ([pair[which][name] for pair in seen] for which in (0, 1))
        assert torch.equal(averages[9], weights[9])  # the last tenth of 10 updates is one update
        torch.testing.assert_close(averages[19], averages[18] + 0.5 * (weights[19] - averages[18]))
        torch.testing.assert_close(averages[29], averages[28] + 0.4 * (weights[29] - averages[28]))


def test_averaged_weights_are_the_latest_ones_when_the_rate_is_one(batch, tiny):
    latest, averaged = collect_averages(make_standalone(tiny, average_rate=1.0), batch, 12)[-1]
    assert all(torch.equal(averaged[name], value) for name, value in latest.items())


def test_restore_learner_restores_averages_and_counts(batch, tiny):
    learner, resumed = make_standalone(tiny), make_standalone(tiny)
    collect_averages(learner, batch, 12)
    metrics = {name: float(value) for name, value in learner.metrics.items()}
    skips = learner.skips[0]
    for value, count in zip((skips.total, skips.streak, skips.longest), (3, 1, 2), strict=True):
        value.fill_(count)
    saved = {"weights": learner.state_dict(), "updates": 12, "metrics": metrics}
    restore_learner(resumed, saved, Path("run"))
    skips = resumed.skips[0]
    kept = learner.averaged.state_dict()
    assert all(torch.equal(value, kept[name]) for name, value in resumed.averaged.state_dict().items())
    assert [int(value) for value in (skips.total, skips.streak, skips.longest)] == [3, 1, 2]
    assert int(resumed.skips[1].total) == 0 and not any("rows" in name for name in saved["weights"])
