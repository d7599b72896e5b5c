"""The losses: their values, their gradients, and the scales that weigh them."""

import pytest
import torch

from latentplan.models import Gaussian, State, WorldModel, kl_divergence
from latentplan.models.backend import lambda_return
from latentplan.training.learner.losses import SMALLEST_ERROR, draw_noise, imagine, imitation_loss, world_model_loss
from latentplan.training.learner.optimization import descend, return_scale


def make_generator():
    return torch.Generator().manual_seed(0)


def compute_returns(rewards, discounts, values, lambda_):
    """G_t = r_t + d_t ((1 - lambda) v_t+1 + lambda G_t+1), starting from the last value."""

    def from_step(time):
        following = values[-1] if time == len(rewards) - 1 else from_step(time + 1)
        return rewards[time] + discounts[time] * ((1 - lambda_) * values[time] + lambda_ * following)

    return torch.stack([from_step(time) for time in range(len(rewards))])


@pytest.fixture
def path():
    rewards, discounts, values = torch.rand(3, 6, 4, generator=make_generator(), dtype=torch.float64)
    return rewards, discounts, values * 10.0


@pytest.mark.parametrize("lambda_", [0.0, 0.5, 0.95, 1.0])
def test_lambda_return_obeys_its_recursion(path, lambda_):
    assert torch.allclose(lambda_return(*path, lambda_), compute_returns(*path, lambda_))


def test_lambda_return_is_the_one_step_target_when_lambda_is_zero(path):
    rewards, discounts, values = path
    assert torch.allclose(lambda_return(*path, 0.0), rewards + discounts * values)


def test_lambda_return_is_the_whole_return_when_lambda_is_one(path):
    rewards, discounts, values = path
    reach = torch.cat([torch.ones(1, 4), discounts]).cumprod(0)
    whole = (reach[:-1] * rewards).sum(0) + reach[-1] * values[-1]
    assert torch.allclose(lambda_return(*path, 1.0)[0], whole)


def test_lambda_return_ignores_steps_beyond_an_end(path):
    rewards, discounts, values = path
    discounts[2] = 0.0
    before = lambda_return(rewards, discounts, values, 0.9)
    rewards[3:], values[2:] = 100.0, 100.0
    assert torch.equal(lambda_return(rewards, discounts, values, 0.9)[:3], before[:3])


def test_world_model_loss_is_the_sum_of_its_losses_times_their_scales(model, batch, tiny):
    chosen = {"reconstruction_scale": 2.0, "reward_scale": 3.0, "representation_scale": 0.5, "overshooting_scale": 0.7}
    config = tiny("", learning=chosen).learning
    loss, states, _, parts = world_model_loss(model, batch, config, make_generator())
    relative = 2.0 / (SMALLEST_ERROR + parts["reconstruction"].item())  # the squared error weighs itself
    scales = {"reconstruction": relative, "reward": 3.0, "continue": 1.0, "dynamics": 1.0, "representation": 0.5}
    scales |= {"overshooting": 0.7, "open_loop_reward": 3.0, "probe": 1.0}
    assert parts.keys() == scales.keys()
    assert loss.item() == pytest.approx(sum(scale * parts[name].item() for name, scale in scales.items()), rel=1e-5)
    assert states.deter.shape == (4, 6, 16) and states.stoch.shape == (4, 6, 32)
    assert not any(part.requires_grad for part in states)


def test_overshooting_predicts_with_the_prior_mean_from_detached_starts(model, batch, tiny):
    """The loss equals a step-by-step computation from the first posterior of each window."""
    horizon = 2
    changes = {"overshooting_scale": 1.0, "overshooting_horizon": horizon, "free_nats": 0.0, "random_shift": 0}
    config = tiny("", learning=changes).learning
    noise = torch.randn(*batch.frames.shape[:2], 32, generator=make_generator())
    with torch.no_grad():
        with model.trunk_precision():
            embeddings = model.encoder(batch.frames.flatten(0, 1)).unflatten(0, batch.frames.shape[:2])
        states, posterior = model.dynamics.observe(embeddings, batch.actions, batch.deter, noise)
        divergences = []
        for start in range(0, batch.actions.shape[1] - horizon + 1, horizon):
            state = State(states.deter[:, start], states.stoch[:, start])
            for time in range(start, start + horizon):
                deter = model.dynamics.advance(state, batch.actions[:, time])
                prior = model.dynamics.prior(deter)
                state = State(deter, prior.mean)
                seen = Gaussian(posterior.mean[:, time + 1], posterior.std[:, time + 1])
                divergences.append(kl_divergence(seen, prior).mean())
    parts = world_model_loss(model, batch, config, make_generator()).parts
    assert parts["overshooting"].item() == pytest.approx(torch.stack(divergences).mean().item(), rel=1e-4)


def test_divergences_below_the_free_nats_are_constant(model, batch, tiny):
    config = tiny("", learning={"free_nats": 1e6}).learning
    parts = world_model_loss(model, batch, config, make_generator()).parts
    assert parts["dynamics"] == parts["representation"] == 1e6


def test_dynamics_and_representation_losses_have_the_same_value(model, batch, tiny):
    parts = world_model_loss(model, batch, tiny("", learning={"free_nats": 0.0}).learning, make_generator()).parts
    assert parts["dynamics"] == pytest.approx(parts["representation"].item(), rel=1e-6)
    assert parts["dynamics"] > 0.0


def find_parts_with_gradient(model):
    return {
        name.split(".")[0]
        for name, parameter in model.named_parameters()
        if parameter.grad is not None and parameter.grad.abs().sum() > 0.0
    }


def test_world_model_loss_has_no_gradient_for_actor_and_value_head(model, batch, tiny):
    world_model_loss(model, batch, tiny("").learning, make_generator()).loss.backward()
    expected = {"encoder", "dynamics", "decoder", "reward_head", "continue_head"}
    assert find_parts_with_gradient(model) == expected


def test_behaviour_loss_has_no_gradient_for_the_world_model(learner, batch):
    learned = world_model_loss(learner.model, batch, learner.config, make_generator())
    loss, _ = learner._behaviour_loss(learned, batch, make_generator())
    descend(learner.configure_optimizers()[1], loss, 100.0, 0)
    assert all(parameter.grad is None for parameter in learner.snapshot.model.dynamics.parameters())
    assert find_parts_with_gradient(learner.model) == {"actor", "value_head"}
    assert all(parameter.grad is None for parameter in learner.target_value.parameters())


def test_imagine_passes_gradients_from_rewards_to_the_actor(model):
    state = State(torch.zeros(3, 16), torch.zeros(3, 32))
    imagined = imagine(model, state, 4, make_generator())
    assert imagined.features.shape == (5, 3, 48)
    assert imagined.rewards.shape == imagined.continues.shape == imagined.entropies.shape == (4, 3)
    imagined.rewards.sum().backward()
    assert "actor" in find_parts_with_gradient(model)


def compute_end_gradients(model, decay):
    """Features of an imagined end, and its gradient with respect to the mean of every action on the way there."""
    means = torch.zeros(4, 3, 1, requires_grad=True)
    actions = iter(means)
    start = State(torch.zeros(3, 16), torch.zeros(3, 32))
    noise = draw_noise(model, 4, 3, make_generator())
    features, _ = model.dynamics.imagine(lambda _: (next(actions), torch.ones(3, 1)), start, *noise, decay)
    features[-1].square().sum().backward()
    return features, means.grad


def test_gradient_decay_scales_gradients_per_step_but_not_the_rollout(model):
    (whole, gradient), (same, decayed) = (compute_end_gradients(model, decay) for decay in (1.0, 0.5))
    assert torch.equal(whole, same)
    assert gradient.abs().min() > 0.0
    shares = torch.tensor([0.125, 0.25, 0.5, 1.0]).view(4, 1, 1)
    assert torch.allclose(decayed, shares * gradient, rtol=1e-3)


def test_imagine_predicts_rewards_from_the_states_they_arrive_with(model):
    imagined = imagine(model, State(torch.zeros(3, 16), torch.zeros(3, 32)), 4, make_generator())
    for time in range(4):
        expected = model.reward_head.mean(model.reward_head(imagined.features[time + 1]))
        assert torch.allclose(imagined.rewards[time], expected, rtol=1e-4, atol=1e-3)


def test_imagine_returns_the_entropy_of_the_gaussian_actor(model):
    imagined = imagine(model, State(torch.zeros(3, 16), torch.zeros(3, 32)), 1, make_generator())
    expected = torch.distributions.Normal(*model.actor(imagined.features[0])).entropy().sum(-1)
    assert torch.allclose(imagined.entropies[0], expected, atol=1e-5)


def test_return_scale_is_at_least_one_and_follows_the_spread(learner):
    assert return_scale(learner.return_range, torch.zeros(100)) == 1.0
    wide = torch.linspace(0.0, 1000.0, 101)  # a spread of 900
    assert [return_scale(learner.return_range, wide).item() for _ in range(2)] == pytest.approx([9.0, 0.99 * 9.0 + 9.0])
    assert [return_scale(learner.return_range, wide) for _ in range(1000)][-1].item() == pytest.approx(900.0, rel=1e-3)


def test_every_parameter_belongs_to_one_optimizer(learner):
    groups = [group["params"] for optimizer in learner.configure_optimizers() for group in optimizer.param_groups]
    owned = [id(parameter) for group in groups for parameter in group]
    assert sorted(owned) == sorted(id(parameter) for parameter in learner.model.parameters())


def test_probe_loss_has_no_gradient_for_the_latent(batch, tiny):
    torch.manual_seed(0)
    model = WorldModel(tiny("").model, action_dim=1, labels={"height": 2.0, "speed": 0.5})
    labelled = batch._replace(labels=torch.randn(4, 6, 2, generator=make_generator()))
    _, states, open_loop, parts = world_model_loss(model, labelled, tiny("").learning, make_generator())
    pairs = ((states.features, labelled.labels), (open_loop, labelled.labels[:, 1 : open_loop.shape[1] + 1]))
    errors = [(model.probe(features) - labels) / torch.tensor([2.0, 0.5]) for features, labels in pairs]
    assert parts["probe"].item() == pytest.approx(sum(error.square().mean().item() for error in errors), rel=0.02)
    with_probe, without = (
        world_model_loss(model, labels, tiny("").learning, make_generator())[0]
        for labels in (labelled, batch._replace(labels=model.probe(states.features).detach()))
    )
    gradients = [torch.autograd.grad(loss, model.encoder.linear.weight)[0] for loss in (with_probe, without)]
    assert torch.equal(*gradients)


def test_probe_learns_its_quantity(batch, tiny):
    torch.manual_seed(0)
    model = WorldModel(tiny("").model, action_dim=1, labels={"height": 2.0})
    features = torch.randn(4, 6, 48, generator=make_generator())
    labels = 3.0 * features[..., :1]
    optimizer = torch.optim.Adam(model.probe_head.parameters(), lr=1e-2)
    for _ in range(150):
        optimizer.zero_grad()
        ((model.probe(features) - labels) / model.label_scales).square().mean().backward()
        optimizer.step()
    assert (model.probe(features) - labels).abs().mean() < 0.5


def make_labels(mean, std):
    return torch.full((40, 1), mean), torch.full((40, 1), std)


def test_imitation_loss_is_the_kl_from_planner_to_actor(model):
    features = torch.randn(40, 48)
    mean, std = make_labels(0.4, 0.25)
    normal = torch.distributions.Normal
    expected = torch.distributions.kl_divergence(normal(mean, std), normal(*model.actor(features))).sum(-1)
    assert torch.allclose(imitation_loss(model.actor, features, mean, std), expected, atol=1e-5)


def test_imitation_loss_clamps_the_std_into_the_range_of_the_actor(model):
    features = torch.randn(40, 48)
    narrow, floor = (imitation_loss(model.actor, features, *make_labels(0.4, std)) for std in (0.01, 0.1))
    assert torch.equal(narrow, floor)
    assert torch.equal(*(imitation_loss(model.actor, features, *make_labels(0.4, std)) for std in (1.0, 3.0)))


def test_imitation_loss_has_a_gradient_for_the_actor_only(model):
    features = torch.randn(40, 48, requires_grad=True)
    imitation_loss(model.actor, features, *make_labels(0.4, 0.2)).mean().backward()
    assert features.grad is None
    assert all(parameter.grad is not None for parameter in model.actor.parameters())
