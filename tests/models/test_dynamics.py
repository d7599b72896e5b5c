"""The RSSM: sequences equal their single steps."""

import torch

from latentplan.models import Gaussian, State, kl_divergence


def gaussian(generator, rows=200):
    return Gaussian(torch.randn(rows, 32, generator=generator), torch.rand(rows, 32, generator=generator) + 0.1)


def test_kl_divergence_is_zero_for_equal_gaussians(generator):
    left = gaussian(generator)
    assert torch.equal(kl_divergence(left, left), torch.zeros(200))


def test_kl_divergence_equals_that_of_torch_distributions(generator):
    left, right = gaussian(generator), gaussian(generator)
    divergence = kl_divergence(left, right)
    expected = torch.distributions.kl_divergence(torch.distributions.Normal(*left), torch.distributions.Normal(*right))
    assert (divergence > 0.0).all()
    assert torch.allclose(divergence, expected.sum(-1), rtol=1e-4)


def test_observe_equals_single_posterior_steps(model, generator):
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


def test_observe_does_not_use_later_frames_or_actions(model, generator):
    embeddings, noise = torch.randn(2, 5, 20, generator=generator), torch.randn(2, 5, 32, generator=generator)
    actions, deter = torch.rand(2, 4, 3, generator=generator), torch.zeros(2, 24)
    before, _ = model.dynamics.observe(embeddings, actions, deter, noise)
    embeddings[:, 3:], actions[:, 2:] = 0.0, 0.0
    after, _ = model.dynamics.observe(embeddings, actions, deter, noise)
    assert torch.equal(before.stoch[:, :3], after.stoch[:, :3])
    assert not torch.allclose(before.stoch[:, 3:], after.stoch[:, 3:])


def test_advance_keeps_deter_within_one(model, state):
    for _ in range(50):
        state = State(model.dynamics.advance(state, torch.ones(5, 3)), state.stoch * 3.0)
    assert state.deter.abs().max() <= 1.0


def test_prior_std_is_at_least_a_tenth(model, generator):
    deter = torch.randn(100, 24, generator=generator) * 50.0
    assert model.dynamics.prior(deter).std.min() >= 0.1


def test_initial_state_is_zero(model):
    assert all(part.eq(0.0).all() and len(part) == 3 for part in model.dynamics.initial(3))
