"""Discrete numbers of an action: their one-hot code, their distribution, and the dynamics that read them."""

import pytest
import torch

from latentplan.config import ModelConfig, UserError
from latentplan.config.spaces import Spaces, category_values
from latentplan.models import State, WorldModel
from latentplan.models.backend import Backend
from latentplan.models.fast import accelerate
from latentplan.models.heads import ActionCode, MixedActor
from latentplan.planning import check_model

CHOICES = (0, 3, 0, 5)
SIZES = ModelConfig(
    deter_dim=32, hidden_dim=32, decoder_width=16, encoder_channels=(8, 8), decoder_channels=2, num_bins=15
)


@pytest.fixture
def actor():
    torch.manual_seed(0)
    actor = MixedActor(6, 16, CHOICES)
    actor.mlp.output.weight.data.normal_(std=0.5)
    return actor


def make_model(choices=CHOICES):
    torch.manual_seed(0)
    model = WorldModel(SIZES, len(choices), spaces=Spaces(choices))
    for head in (model.actor, model.reward_head):
        head.mlp.output.weight.data.normal_(std=0.3)
    return model


def test_code_keeps_continuous_numbers_and_marks_the_category():
    code = ActionCode(CHOICES)
    action = torch.tensor([0.25, category_values(3)[2], -0.5, category_values(5)[1]])
    assert code(action).tolist() == [0.25, -0.5, *(0, 0, 1), *(0, 1, 0, 0, 0)]
    assert code.size == 10


def test_code_reads_every_number_of_a_part_as_the_same_category():
    code = ActionCode((4,))
    numbers = torch.linspace(-1.0, 1.0, 1001)[:, None]
    assert torch.equal(code(numbers).argmax(-1), ((numbers[:, 0] + 1.0) * 2.0).floor().clamp(max=3).long())
    assert torch.allclose(code.values(code.find(numbers)), code.values(code.find(code.values(code.find(numbers)))))


def test_code_shows_numbers_that_are_not_finite():
    assert ActionCode((4, 0))(torch.tensor([float("nan"), 0.0])).isnan().any()


def test_samples_have_the_probabilities_of_the_distribution(actor):
    torch.manual_seed(1)
    features = torch.randn(1, 6).expand(40_000, 6)
    actions = actor.sample(features, torch.randn(40_000, 4))
    for values, place in ((category_values(3), 1), (category_values(5), 3)):
        for value in values:
            taken = torch.tensor([[0.0, 0.0, 0.0, 0.0]])
            taken[0, place] = value
            share = (actions[:, place] - value).abs().lt(1e-6).float().mean()
            other = torch.cat([taken.clone().index_fill_(1, torch.tensor(place), v) for v in values])
            scores = actor.score(features[: len(values)], other)[0].softmax(0)  # the other numbers are the same
            assert abs(share - scores[values.index(value)]) < 0.01


def test_noise_of_zero_gives_the_mode(actor):
    features = torch.randn(50, 6)
    mode, std = actor(features)
    assert torch.equal(actor.sample(features, torch.zeros(50, 4)), mode)
    assert (std > 0.0).all()
    best = actor.score(features, mode)[0]
    for _ in range(100):
        actions = actor.sample(features, torch.randn(50, 4))
        is_inside = (actions.abs() < 1.0).all(-1)  # a bound has a probability, and what lies inside a density
        assert (actor.score(features, actions)[0] <= best + 1e-5)[is_inside].all()


def test_entropy_is_the_mean_negative_log_probability():
    torch.manual_seed(0)
    actor = MixedActor(6, 16, (4, 3))
    actor.mlp.output.weight.data.normal_(std=0.5)
    features = torch.randn(1, 6).expand(20_000, 6)
    log_probs, entropy = actor.score(features, actor.sample(features, torch.randn(20_000, 2)))
    assert torch.allclose(-log_probs.mean(), entropy[0], atol=0.02)


def test_mean_of_the_score_is_0_where_numbers_are_clamped():
    torch.manual_seed(0)
    actor = MixedActor(6, 16, (0, 2))
    actor.mlp.output.weight.data.normal_(std=0.5)
    actor.mlp.output.bias.data[0] = 2.0  # a mean near the upper bound
    features = torch.randn(1, 6).expand(100_000, 6)
    actions = actor.sample(features, torch.randn(100_000, 2)).detach()
    assert 0.2 < (actions[:, 0] == 1.0).float().mean() < 0.8
    actor.score(features, actions)[0].mean().backward()
    assert actor.mlp.output.bias.grad.abs().max() < 0.01


def test_score_raises_the_probability_of_rewarded_categories():
    torch.manual_seed(0)
    actor, features = MixedActor(2, 16, (4,)), torch.ones(256, 2)
    optimizer = torch.optim.Adam(actor.parameters(), lr=1e-2)
    for _ in range(100):
        actions = actor.sample(features, torch.randn(256, 1)).detach()
        reward = (actions[:, 0] - category_values(4)[2]).abs().lt(1e-6).float()
        loss = -((reward - reward.mean()) * actor.score(features, actions)[0]).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert torch.allclose(actor(features[:1])[0], torch.tensor(category_values(4)[2]))


def test_fast_backends_agree_with_plain_torch():
    model = accelerate(make_model())
    torch.manual_seed(2)
    state = State(torch.randn(8, 32), torch.randn(8, 32))
    actions = torch.rand(8, 5, 4) * 2 - 1
    embeddings, noise = torch.randn(8, 6, 32), torch.randn(8, 6, 32)
    plain = Backend(model.trunk_dtype)
    with torch.no_grad():
        (ours, _), (theirs, _) = (each.rollout(model, state, actions) for each in (model.backend, plain))
        model.backend.trunk_dtype = torch.float32
        (exact, _), (single, _) = (each.rollout(model, state, actions) for each in (Backend(), model.backend))
        model.backend.trunk_dtype = plain.trunk_dtype
        assert torch.allclose(single, exact, atol=0.02)
        assert (ours - exact).abs().mean() <= 1.1 * (
            theirs - exact
        ).abs().mean() + 0.02  # no worse than torch's rounding
        seen = [each.observe(model, embeddings, actions, state.deter, noise)[0] for each in (model.backend, plain)]
        assert torch.allclose(seen[0].features, seen[1].features, atol=0.1)
        open_loop = [each.predict(model, state, actions)[0] for each in (model.backend, plain)]
        assert torch.allclose(*open_loop, atol=0.1)


def test_dynamics_depend_on_the_category_alone():
    model = make_model((4,))
    state = State(torch.randn(1, 32), torch.randn(1, 32))
    deters = [model.dynamics.advance(state, torch.tensor([[value]])) for value in (-0.9, -0.6, -0.4)]
    assert torch.equal(deters[0], deters[1]) and not torch.equal(deters[1], deters[2])


def test_model_satisfies_the_planners_protocol():
    model = make_model()
    report = check_model(model, model.dynamics.initial(2), action_dim=4, action_choices=Spaces(CHOICES).action_choices)
    assert report is None or not getattr(report, "problems", [])


@pytest.mark.parametrize("choices", [(1,), (-2,), (2.0,), (5000,)])
def test_spaces_refuse_other_numbers_of_categories(choices):
    with pytest.raises(ValueError, match="choices must be"):
        Spaces(choices)


def test_model_refuses_what_needs_continuous_actions():
    with pytest.raises(UserError, match="turns 4 needs continuous actions"):
        WorldModel(ModelConfig(turns=4), 1, spaces=Spaces((3,)))
    with pytest.raises(UserError, match="continuous actions only"):
        WorldModel(SIZES, 1, {"speed": 1.0}, goal_dim=8, spaces=Spaces((3,)))
    with pytest.raises(ValueError, match="one entry for each of 2 numbers"):
        WorldModel(SIZES, 2, spaces=Spaces((3,)))


def test_features_that_are_nan_give_actions_that_are_nan(actor):
    features = torch.randn(3, 6)
    features[1] = torch.nan
    for action in (
        actor(features)[0],
        actor.sample(features, torch.randn(3, 4)),
        actor.sample(features, torch.zeros(3, 4)),
    ):
        assert action[1].isnan().all() and action[[0, 2]].isfinite().all()
