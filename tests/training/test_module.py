"""The learner: model and behaviour side by side, as if one after the other."""

import pytest
import torch

from latentplan.models import WorldModel
from latentplan.replay import Replay
from latentplan.training.module import Learner


class Standalone(Learner):
    """A learner that holds its own optimizers, so that it updates without a Trainer."""

    def optimizers(self, use_pl_optimizer=True):
        self.__dict__.setdefault("own", self.configure_optimizers())
        return self.own


def standalone(tiny, **learning):
    torch.manual_seed(0)
    config = tiny("", learning=learning)
    model = WorldModel(config.model, action_dim=1)
    return Standalone(model, config.learning, 0.9, Replay(24, 1, 16, 1, torch.device("cpu")), seed=0)


def test_behaviour_learns_each_batch_from_the_model_as_the_same_batch_left_it(batch, tiny):
    """Side by side the two halves give exactly what they give one after the other."""
    overlapped, in_turn = standalone(tiny), standalone(tiny)
    for _ in range(4):
        overlapped.training_step(batch, 0)
        in_turn.training_step(batch, 0)
        in_turn.catch_up()
    overlapped.catch_up()
    weights, expected = overlapped.model.state_dict(), in_turn.model.state_dict()
    assert all(torch.equal(weights[name], expected[name]) for name in expected)
    assert overlapped.metrics.keys() == in_turn.metrics.keys() >= {"actor", "reconstruction"}


def test_an_update_changes_model_and_behaviour_and_their_snapshot(batch, tiny):
    learner = standalone(tiny)
    before = {name: value.clone() for name, value in learner.model.state_dict().items()}
    learner.training_step(batch, 0)
    moved = {name for name, value in learner.model.state_dict().items() if not torch.equal(value, before[name])}
    assert any(name.startswith("dynamics") for name in moved)
    assert not any(name.startswith(("actor", "value_head")) for name in moved)
    learner.catch_up()
    assert not torch.equal(learner.model.actor.mlp.output.weight, before["actor.mlp.output.weight"])
    frozen, own = learner.snapshot.model, learner.model
    assert torch.equal(frozen.dynamics.gates.weight, own.dynamics.gates.weight.bfloat16())
    assert torch.equal(frozen.reward_head.mlp.output.weight, own.reward_head.mlp.output.weight)
    assert frozen.actor is own.actor and not frozen.dynamics.gates.weight.requires_grad


def test_what_fails_in_behaviour_is_raised_in_the_update(batch, tiny):
    learner = standalone(tiny)
    learner.training_step(batch, 0)
    with torch.no_grad():
        learner.model.value_head.mlp.output.bias.fill_(float("nan"))
    with pytest.raises(FloatingPointError, match="not finite"):
        learner.catch_up()


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_beliefs_of_turned_sequences_are_not_kept(batch, tiny, share):
    learner = standalone(tiny, turned_share=share)
    learner.training_step(batch, 0)
    assert (learner.replay.deter[batch.rows] == 0.0).all() == (share == 1.0)


def test_annealing_slows_both_optimizers_and_can_be_taken_back(tiny):
    learner = standalone(tiny, model_learning_rate=1e-3, behaviour_learning_rate=4e-4)
    for factor in (0.5, 1.0):
        learner.anneal(factor)
        rates = [[group["lr"] for group in optimizer.param_groups] for optimizer in learner.optimizers()]
        assert rates == [[factor * 1e-3], [factor * 4e-4]]


def test_an_annealed_learner_is_one_with_smaller_settings(batch, tiny):
    def learned(factor, **settings):
        learner = standalone(tiny, **settings)
        learner.anneal(factor)
        learner.training_step(batch, 0)
        learner.catch_up()
        return {name: value.item() for name, value in learner.metrics.items()}

    whole = {"model_learning_rate": 2e-3, "behaviour_learning_rate": 4e-4, "entropy_scale": 2.0}
    assert learned(0.5, **whole) == learned(1.0, **{name: value / 2 for name, value in whole.items()})
    assert learned(0.5, **whole) != learned(0.5, **whole | {"entropy_scale": 1.0})
