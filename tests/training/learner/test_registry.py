"""The registry of losses: every loss has its scale, every scale its loss, and a new loss enters the sums."""

import dataclasses

import pytest
import torch

from latentplan.config import LearningConfig
from latentplan.training.learner.losses import world_model_loss
from latentplan.training.learner.registry import BEHAVIOUR_LOSSES, WORLD_MODEL_LOSSES, register, weighted_sum


def make_generator():
    return torch.Generator().manual_seed(0)


def test_every_scale_setting_weighs_a_loss():
    """`entropy_scale` weighs a term within the actor's loss; every other scale belongs to a registered loss."""
    settings = {field.name for field in dataclasses.fields(LearningConfig) if field.name.endswith("_scale")}
    used = {loss.scale for loss in (WORLD_MODEL_LOSSES | BEHAVIOUR_LOSSES).values()}
    assert settings == (used - {None}) | {"entropy_scale"}


def test_register_refuses_a_name_that_is_taken_and_a_scale_without_setting():
    with pytest.raises(ValueError, match="already a loss 'reward'"):
        register(BEHAVIOUR_LOSSES, "reward")
    with pytest.raises(ValueError, match="'surprise' is weighed by 'surprise_scale', which is no setting"):
        register(WORLD_MODEL_LOSSES, "surprise", "surprise_scale")


def test_registered_losses_enter_both_sums(learner, batch, restored_losses):
    """The added losses are 1 for the world model, and 2 with the scale 3 for behaviour."""
    before = world_model_loss(learner.model, batch, learner.config, make_generator())
    behaviour_before, _ = learner._behaviour_loss(before, batch, make_generator())
    learner.return_range.zero_()
    learner.config = dataclasses.replace(learner.config, reward_scale=3.0)
    register(WORLD_MODEL_LOSSES, "one")(lambda predicted: predicted.batch.rewards.new_ones(()))
    register(BEHAVIOUR_LOSSES, "two", "reward_scale")(lambda behaviour: behaviour.returns.new_full((), 2.0))
    rewards = before.parts["reward"] + before.parts["open_loop_reward"]
    after = world_model_loss(learner.model, batch, learner.config, make_generator())
    assert after.loss.item() == pytest.approx((before.loss + 1.0 + 2.0 * rewards).item(), rel=1e-5)
    behaviour_after, parts = learner._behaviour_loss(before, batch, make_generator())
    assert behaviour_after.item() == pytest.approx(behaviour_before.item() + 6.0, rel=1e-5)
    assert (after.parts["one"], parts["two"]) == (1.0, 2.0)


@pytest.mark.parametrize("unit", [1.0, 100.0])
def test_a_relative_loss_has_the_gradient_of_its_logarithm_whatever_its_unit(unit):
    """Of several numbers each is weighed by itself; where several processes share a batch, by their common mean."""
    place = torch.tensor([0.5, -2.0], requires_grad=True)
    losses = {}
    register(losses, "distance", "vector_scale", floor=0.0)(lambda inputs: (unit * inputs).square())
    config = dataclasses.replace(LearningConfig(), vector_scale=3.0)
    total, parts = weighted_sum(losses, place, config)
    (gradient,) = torch.autograd.grad(total, place)
    assert torch.allclose(gradient, 3.0 * 2.0 / place.detach())
    assert parts["distance"].item() == pytest.approx(unit**2 * 4.25)
    shared, _ = weighted_sum(losses, place, config, lambda own: 2.0 * own)
    assert torch.allclose(*torch.autograd.grad(shared, place), 0.5 * gradient)
