"""Beliefs about a frame and its three quarter turns."""

import pickle

import pytest
import torch

from latentplan.config import ModelConfig
from latentplan.models import State, WorldModel
from latentplan.models.symmetry import QUARTERS, TurnedModel, first_turn, flat, folded, mean_over_turns, turned
from latentplan.planning import CEMPlanner
from latentplan.planning.check import check_model
from latentplan.planning.objectives import learned_return, risk, terminal_value
from latentplan.planning.search.scorer import Scorer

SIZES = ModelConfig(
    deter_dim=16, hidden_dim=16, decoder_width=8, encoder_channels=(8, 8), decoder_channels=2, num_bins=15
)


@pytest.fixture(scope="module")
def model():
    torch.manual_seed(0)
    model = WorldModel(SIZES, action_dim=2, labels={"height": 1.0}).requires_grad_(False)
    for head in (model.reward_head, model.value_head, model.actor):
        head.mlp.output.weight.normal_(std=0.5)
    return model


@pytest.fixture
def beliefs():
    """Beliefs about three environments, four turns each."""
    generator = torch.Generator().manual_seed(1)
    return State(*(torch.randn(3, QUARTERS, size, generator=generator) for size in (16, 32)))


def plan_for(model, state, **options):
    planner = CEMPlanner(action_dim=2, horizon=3, num_samples=24, num_elites=6, num_policy_samples=6, discount=0.9)
    return planner.plan(model, state, generator=torch.Generator().manual_seed(2), **options)


def test_turned_puts_the_frame_first_and_four_turns_restore_it():
    frames = torch.randint(0, 256, (2, 64, 64, 3), dtype=torch.uint8)
    turns = turned(frames).unflatten(0, (2, QUARTERS))
    assert torch.equal(turns[:, 0], frames)
    again = turned(turns[:, 3]).unflatten(0, (2, QUARTERS))
    assert torch.equal(again[:, 1], frames) and not torch.equal(turns[:, 1], frames)
    assert turned(frames, 1) is frames


def test_folded_and_flat_are_inverse(beliefs):
    rows = flat(beliefs)
    assert rows.deter.shape == (12, 16)
    assert all(torch.equal(one, other) for one, other in zip(folded(rows, QUARTERS), beliefs, strict=True))
    assert torch.equal(first_turn(beliefs).stoch, beliefs.stoch[:, 0])
    assert all(torch.equal(one, other) for one, other in zip(flat(rows), rows, strict=True))
    assert torch.equal(mean_over_turns(rows.deter, beliefs), beliefs.deter.mean(1))


@pytest.mark.parametrize("method", ["value", "continues", "policy"])
def test_turned_model_returns_the_mean_over_turns(method, model, beliefs):
    wrapped = TurnedModel(model)
    each = torch.stack([getattr(model, method)(State(*(part[:, turn] for part in beliefs))) for turn in range(4)])
    assert torch.allclose(getattr(wrapped, method)(beliefs), each.mean(0), atol=1e-2)  # a trunk in bfloat16
    assert torch.allclose(getattr(wrapped, method)(flat(beliefs)), getattr(model, method)(flat(beliefs)), atol=1e-2)


@pytest.mark.parametrize("method", ["step", "fast_step"])
def test_turned_model_step_advances_every_turn(method, model, beliefs):
    action = torch.rand(3, 2) * 2 - 1
    following, reward = getattr(TurnedModel(model), method)(beliefs, action)
    for turn in range(QUARTERS):
        alone, _ = getattr(model, method)(State(*(part[:, turn] for part in beliefs)), action)
        assert torch.allclose(following.stoch[:, turn], alone.stoch, atol=2e-2)
    rewards = [getattr(model, method)(State(*(part[:, turn] for part in beliefs)), action)[1] for turn in range(4)]
    assert torch.allclose(reward, torch.stack(rewards).mean(0), atol=2e-2)


@pytest.mark.parametrize("num", [1, 3, 6])
def test_turned_model_proposes_the_mode_of_all_turns_then_of_each_turn(num, model, beliefs):
    wrapped, streams = TurnedModel(model), [torch.Generator().manual_seed(seed) for seed in range(3)]
    proposals = wrapped.propose(beliefs, num, 5, streams)
    assert proposals.shape == (3 * num, 5, 2)
    modes = torch.cat([wrapped.policy(beliefs)[:, None], model.policy(flat(beliefs)).unflatten(0, (3, QUARTERS))], 1)
    first = proposals.unflatten(0, (3, num))[:, :, 0]
    assert torch.allclose(first[:, :5].float(), modes[:, :num].float(), atol=0.05)  # a trunk in bfloat16
    state, _ = wrapped.step(beliefs, proposals[::num, 0])
    assert torch.allclose(proposals[::num, 1].float(), wrapped.policy(state).float(), atol=0.05)


def test_turned_model_scores_equal_turns_like_a_single_belief(model, beliefs):
    alike = State(*(part[:, :1].expand(-1, QUARTERS, -1).contiguous() for part in beliefs))
    actions = torch.rand(3, 24, 3, 2) * 2 - 1
    one, all_turns = (
        scores(wrapped, state, actions) for wrapped, state in ((model, first_turn(alike)), (TurnedModel(model), alike))
    )
    assert torch.allclose(one, all_turns, atol=2e-2) and one.std() > 0.1


def test_turned_model_scores_a_candidate_by_the_mean_over_turns(model, beliefs):
    actions = torch.rand(3, 24, 3, 2) * 2 - 1
    each = [scores(model, State(*(part[:, turn] for part in beliefs)), actions) for turn in range(QUARTERS)]
    together = scores(TurnedModel(model), beliefs, actions)
    assert torch.allclose(together, torch.stack(each).mean(0), atol=2e-2)
    assert not torch.allclose(together, each[0], atol=0.1)


def scores(model, state, actions):
    """Returns of candidates, (batch, sample)."""
    discounts = 0.9 ** torch.arange(actions.shape[2] + 1)
    scorer = Scorer.build(model, None, (), discounts, terminal_value=None, use_continues=False, penalty=None)
    return scorer.score(scorer.start_rows(state, actions.shape[1]), actions).returns


def test_plan_with_turned_model_does_not_depend_on_other_environments(model, beliefs):
    wrapped = TurnedModel(model)
    plan = plan_for(wrapped, beliefs)
    alone = plan_for(wrapped, State(*(part[1:2] for part in beliefs)))
    assert plan.actions.shape == (3, 3, 2)
    assert torch.allclose(plan.actions[1], alone.actions[0], atol=0.1)
    assert plan_for(wrapped, beliefs, previous=plan).actions.shape == (3, 3, 2)


def test_turned_model_particles_repeat_its_turns(model, beliefs):
    wrapped = TurnedModel(model)
    assert torch.equal(wrapped.particles(beliefs, 6).stoch[4:6], beliefs.stoch[0, :2])
    worst = risk(learned_return() + terminal_value(), measure="worst", num_particles=QUARTERS)
    assert torch.isfinite(plan_for(wrapped, beliefs, objective=worst).actions).all()


def test_turned_model_can_be_pickled(model, beliefs):
    wrapped = pickle.loads(pickle.dumps(TurnedModel(model)))
    assert torch.allclose(wrapped.value(beliefs), TurnedModel(model).value(beliefs))
    assert wrapped.label_names == ("height",)
    check_model(wrapped, beliefs, 2)
