"""The recurrence with its gradient written out gives what autograd's gives."""

from types import SimpleNamespace

import pytest
import torch

from latentplan.models import State, WorldModel
from latentplan.models.dynamics import Rssm
from latentplan.models.fast import unroll
from latentplan.models.heads import Actor
from latentplan.training.learner import losses
from tests.training.learner.test_graphed import draws, graphed

ROWS, TIME = 4, 6
SIZES = {"latent_dim": 5, "deter_dim": 12, "hidden_dim": 10, "action_dim": 3}


@pytest.fixture
def dynamics():
    torch.manual_seed(0)
    made = Rssm(**SIZES, embedding_dim=7)
    for parameter in made.parameters():
        torch.nn.init.normal_(parameter, std=0.4)
    return made


def states():
    return State(torch.randn(ROWS, 12), torch.randn(ROWS, 5))


def weighed(outputs):
    """A scalar to which every number of the outputs counts differently."""
    generator = torch.Generator().manual_seed(1)
    return sum((part * torch.randn(part.shape, generator=generator)).sum() for part in outputs)


def assert_same_gradients(outputs_of, parameters, reached):
    """The same outputs both ways, and gradients, of which those of `reached` parameters are of something."""
    outcomes = []
    for pays in (False, True):
        outputs = outputs_of(pays)
        outcomes.append((outputs, torch.autograd.grad(weighed(outputs), parameters, allow_unused=True)))
    (expected, gradients), (given, own) = outcomes
    for one, other in zip(expected, given, strict=True):
        torch.testing.assert_close(other, one, rtol=1e-5, atol=1e-5)
    assert sum(gradient is not None and bool(gradient.any()) for gradient in own) == reached
    for one, other in zip(gradients, own, strict=True):
        torch.testing.assert_close(other, one, rtol=1e-4, atol=1e-4)


def test_what_is_observed_is_the_same(dynamics, monkeypatch):
    embeddings = torch.randn(ROWS, TIME + 1, 7, requires_grad=True)
    actions, noise = torch.rand(ROWS, TIME, 3) * 2 - 1, torch.randn(ROWS, TIME + 1, 5)
    deter = torch.randn(ROWS, 12)

    def outputs(pays):
        monkeypatch.setattr(unroll, "pays", lambda tensor: pays)
        state, posterior = unroll.observe(dynamics, embeddings, actions, deter, noise)
        return (*state, *posterior)

    assert_same_gradients(outputs, [embeddings, *dynamics.parameters()], 12)


def test_what_is_followed_is_the_same(dynamics, monkeypatch):
    start, actions = states(), torch.rand(ROWS, TIME, 3) * 2 - 1

    def outputs(pays):
        monkeypatch.setattr(unroll, "pays", lambda tensor: pays)
        deter, prior = unroll.follow(dynamics, start, actions)
        return (deter, *prior)

    assert_same_gradients(outputs, list(dynamics.parameters()), 11)


@pytest.mark.parametrize("decay", [1.0, 0.7])
def test_what_is_dreamt_is_the_same(dynamics, decay):
    actor, start = Actor(17, 10, 3), states()
    for parameter in actor.parameters():
        torch.nn.init.normal_(parameter, std=0.4)
    model = SimpleNamespace(
        dynamics=dynamics, action_dim=3, config=SimpleNamespace(**SIZES), device=torch.device("cpu")
    )

    def outputs(pays):
        generator = torch.Generator().manual_seed(3)
        if not pays:
            return losses.roll_out(model, actor, start, TIME, generator, decay)
        features, std = unroll.dream(dynamics, actor, start, *losses._draws(model, TIME, ROWS, generator), decay)
        return features, losses._entropy(std)

    assert_same_gradients(outputs, list(actor.parameters()), 8)


def test_an_update_is_the_same(tiny, monkeypatch):
    """Both losses of a whole update, and what became of the weights."""
    learners = []
    for pays in (False, True):
        monkeypatch.setattr(unroll, "pays", lambda tensor, pays=pays: pays)
        monkeypatch.setattr(WorldModel, "trunk_dtype", torch.float32)
        learner = graphed(tiny)
        for rows in draws(learner.replay, 2):
            learner.training_step(rows, 0)
        learners.append(learner)
    (expected, parts), (given, own) = ((learner.state_dict(), learner.metrics) for learner in learners)
    for name, value in parts.items():
        torch.testing.assert_close(own[name], value, rtol=1e-4, atol=1e-5, msg=name)
    for name, value in expected.items():
        torch.testing.assert_close(given[name], value, rtol=1e-2, atol=1e-4, msg=name)
