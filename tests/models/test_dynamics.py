"""The RSSM: the belief after a sequence is the belief after its steps."""

import torch

from latentplan.models import Gaussian, State, kl_divergence


def gaussian(generator, rows=200):
    return Gaussian(torch.randn(rows, 32, generator=generator), torch.rand(rows, 32, generator=generator) + 0.1)


def test_the_divergence_of_equals_is_zero(generator):
    left = gaussian(generator)
    assert torch.equal(kl_divergence(left, left), torch.zeros(200))


def test_the_divergence_of_others_is_positive_and_the_known_one(generator):
    left, right = gaussian(generator), gaussian(generator)
    divergence = kl_divergence(left, right)
    expected = torch.distributions.kl_divergence(torch.distributions.Normal(*left), torch.distributions.Normal(*right))
    assert (divergence > 0.0).all()
    assert torch.allclose(divergence, expected.sum(-1), rtol=1e-4)


def test_observing_a_sequence_equals_stepping_by_hand(model, generator):
    dynamics = model.dynamics
    embeddings = torch.randn(2, 5, 20, generator=generator)
    actions = torch.rand(2, 4, 3, generator=generator) * 2 - 1
    noise = torch.randn(2, 5, 32, generator=generator)
    deter = torch.rand(2, 24, generator=generator)
    states, posteriors = dynamics.observe(embeddings, actions, deter, noise)
    assert states.deter.shape == (2, 5, 24) and states.stoch.shape == posteriors.std.shape == (2, 5, 32)
    for time in range(5):
        posterior = dynamics.posterior(deter, embeddings[:, time])
        stoch = posterior.mean + posterior.std * noise[:, time]
        assert torch.allclose(states.deter[:, time], deter, atol=1e-6)
        assert torch.allclose(states.stoch[:, time], stoch, atol=1e-5)
        assert torch.allclose(posteriors.mean[:, time], posterior.mean, atol=1e-5)
        if time < 4:
            deter = dynamics.advance(State(deter, stoch), actions[:, time])


def test_what_comes_later_does_not_change_a_belief(model, generator):
    embeddings, noise = torch.randn(2, 5, 20, generator=generator), torch.randn(2, 5, 32, generator=generator)
    actions, deter = torch.rand(2, 4, 3, generator=generator), torch.zeros(2, 24)
    before, _ = model.dynamics.observe(embeddings, actions, deter, noise)
    embeddings[:, 3:], actions[:, 2:] = 0.0, 0.0
    after, _ = model.dynamics.observe(embeddings, actions, deter, noise)
    assert torch.equal(before.stoch[:, :3], after.stoch[:, :3])
    assert not torch.allclose(before.stoch[:, 3:], after.stoch[:, 3:])


def test_the_deterministic_state_stays_within_one(model, state):
    for _ in range(50):
        state = State(model.dynamics.advance(state, torch.ones(5, 3)), state.stoch * 3.0)
    assert state.deter.abs().max() <= 1.0


def test_every_std_has_a_floor(model, generator):
    deter = torch.randn(100, 24, generator=generator) * 50.0
    assert model.dynamics.prior(deter).std.min() >= 0.1


def test_before_anything_was_seen_the_state_is_zero(model):
    assert all(part.eq(0.0).all() and len(part) == 3 for part in model.dynamics.initial(3))
