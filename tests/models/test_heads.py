"""Distributional scalars and the actor's Gaussian."""

import pytest
import torch

from latentplan.models.heads import Actor, Mlp, ScalarHead, sample_action, symexp

TARGETS = torch.tensor([-8000.0, -513.2, -1.0, -0.013, 0.0, 1e-4, 0.4, 1.0, 2.0, 499.7, 500.4, 7999.0])


@pytest.fixture
def head():
    torch.manual_seed(0)
    return ScalarHead(in_features=6, hidden_dim=8, num_bins=63)


def best_logits(head, target):
    """Logits of the distribution that the loss pulls to: found as the gradient of the loss at uniform logits."""
    logits = torch.zeros(*target.shape, len(head.bins), requires_grad=True)
    head.loss(logits, target).sum().backward()
    return (1.0 / len(head.bins) - logits.grad).clamp_min(0.0).log()


def test_scalar_head_mean_of_the_target_distribution_is_the_target(head):
    # Four significant digits: a weight between bins of thousands is a float32 near 1.
    assert torch.allclose(head.mean(best_logits(head, TARGETS)), TARGETS, rtol=1e-4, atol=2e-4)


def test_scalar_head_target_uses_at_most_two_neighbouring_bins(head):
    for row in best_logits(head, TARGETS).exp():
        held = row.gt(1e-6).nonzero().squeeze(-1)
        assert 1 <= len(held) <= 2
        assert held[-1] - held[0] <= 1


def test_scalar_head_loss_is_smallest_at_the_target_distribution(head):
    best = best_logits(head, TARGETS).clamp_min(-30.0)
    entropy = -(best.log_softmax(-1) * best.softmax(-1)).sum(-1)
    assert torch.allclose(head.loss(best, TARGETS), entropy, atol=1e-4)
    other = best + torch.randn(best.shape, generator=torch.Generator().manual_seed(0))
    assert (head.loss(other, TARGETS) >= head.loss(best, TARGETS)).all()


def test_scalar_head_saturates_for_targets_beyond_the_bins(head):
    top = head.mean(best_logits(head, torch.tensor([1e9])))
    assert torch.allclose(top, head.values[-1:], rtol=1e-4)


def test_scalar_head_loss_is_nan_for_a_nan_target(head):
    assert head.loss(torch.zeros(1, 63), torch.tensor([float("nan")])).isnan().all()


@pytest.mark.parametrize("num_bins", [3, 31, 62, 63, 255])
def test_scalar_head_predicts_zero_when_untrained(num_bins):
    head = ScalarHead(in_features=6, hidden_dim=8, num_bins=num_bins)
    # Bins reach 8,100 to both sides and cancel in float32.
    assert head.mean(head(torch.randn(4, 6))).abs().max() < 1e-3


def test_scalar_head_spaces_bins_evenly_in_symlog_space(head):
    assert torch.allclose(symexp(head.bins), head.values)
    assert torch.allclose(head.values.sign() * head.values.abs().log1p(), head.bins, atol=1e-5)
    assert torch.allclose(head.bins.diff(), head.bins.diff()[0], atol=1e-5)


def test_heads_return_float32_under_autocast(head):
    features = torch.randn(4, 6)
    actor = Actor(6, 8, 2)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        outputs = [head(features), head.mean(head(features)), Mlp(6, 8, 1)(features), *actor(features)]
    assert all(output.dtype == torch.float32 for output in outputs)


def test_actor_bounds_means_and_stds():
    torch.manual_seed(0)
    actor = Actor(6, 8, 2)
    with torch.no_grad():
        actor.mlp.output.weight.normal_(std=20.0)
    mean, std = actor(torch.randn(500, 6) * 10.0)
    assert mean.abs().max() <= 1.0 and mean.abs().max() > 0.9
    assert 0.1 <= std.min() and std.max() <= 1.0


def test_sample_action_clamps_values_and_passes_every_gradient():
    mean = torch.linspace(-1.0, 1.0, 101, requires_grad=True)
    noise = torch.randn(101, generator=torch.Generator().manual_seed(0)) * 5.0
    action = sample_action(mean, torch.ones(101), noise)
    action.sum().backward()
    assert action.abs().max() <= 1.0
    assert torch.allclose(action, (mean + noise).clamp(-1.0, 1.0))
    assert (mean.grad == 1.0).all()
