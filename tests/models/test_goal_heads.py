"""Heads for goals, and the view of the model through them."""

import math

import pytest
import torch

from latentplan.models import WorldModel
from latentplan.objectives.box import BoxView
from latentplan.objectives.objective import build_constraint
from latentplan.objectives.parser import parse_constraints
from latentplan.planning import CEMPlanner, check_model, conditioned

LABELS = {"height": 0.5, "speed": 2.0, "task.walk": 0.5}
GOAL = {"speed": (-1.0, -1.0)}


@pytest.fixture(scope="module")
def goal_model(model):
    """The model with quantities and with heads for goals, whose weights are random."""
    torch.manual_seed(1)
    goal_model = WorldModel(model.config, 3, LABELS, goal_dim=16)
    goal_model.load_state_dict(model.state_dict(), strict=False)
    with torch.no_grad():
        for parameter in (*goal_model.goal_heads.parameters(), *goal_model.probe_head.parameters()):
            parameter.add_(0.3 * torch.randn(parameter.shape))
    return goal_model.eval()


def test_goal_names_are_all_labels_but_task_rewards(goal_model):
    assert goal_model.goal_names == ("height", "speed") and goal_model.goal_scales.tolist() == [0.5, 2.0]


def test_goal_heads_raise_for_a_model_without_labels(model):
    with pytest.raises(ValueError, match="without labels"):
        WorldModel(model.config, 3, goal_dim=16)


def test_goal_heads_do_not_change_other_predictions(model, goal_model, state, generator):
    actions = torch.rand(5, 4, 3, generator=generator) * 2 - 1
    with torch.no_grad():
        rewards, last = model.rollout(state, actions)
        same_rewards, same_last = goal_model.rollout(state, actions)
        assert torch.equal(rewards, same_rewards) and torch.equal(last.features, same_last.features)
        assert torch.equal(model.value(state), goal_model.value(state))
        assert torch.equal(model.policy(state), goal_model.policy(state))


def test_encode_distinguishes_missing_ends_from_ends_at_zero(goal_model):
    heads, inf = goal_model.goal_heads, math.inf
    ends = [((-inf, -inf), (inf, inf)), ((-inf, 0.0), (inf, inf)), ((-inf, 0.0), (inf, 0.0)), ((-inf, 1.0), (inf, inf))]
    codes = [heads.encode(torch.tensor(low), torch.tensor(high)) for low, high in ends]
    assert all(bool(torch.isfinite(code).all()) and code.shape == (8,) for code in codes)
    assert len({tuple(code.tolist()) for code in codes}) == 4


def test_box_view_follows_the_planner_protocol(goal_model, state, generator):
    view = BoxView(GOAL, frames_per_step=2)(goal_model)
    check_model(view, state, action_dim=3)
    action = torch.zeros(5, 3)
    with torch.no_grad():
        following, worth = view.step(state, action)
        expected, _ = goal_model.step(state, action)
        missing = (goal_model.probe(expected.features)[:, 1].float() + 1.0).abs() / 2.0
        assert torch.equal(following.deter, expected.deter)
        assert torch.allclose(worth, 1.0 * (0.1 ** missing.square() + 1.0 / (1.0 + missing)), atol=1e-4)
        assert torch.equal(view.probe(state.features), goal_model.probe(state.features))
        proposals = view.propose(state, 4, 3, [torch.Generator().manual_seed(row) for row in range(5)])
        alone = view.propose(type(state)(*(part[2:3] for part in state)), 4, 3, [torch.Generator().manual_seed(2)])
        assert proposals.shape == (20, 3, 3) and proposals.abs().max() <= 1.0
        code = goal_model.goal_heads.encode(torch.tensor([-math.inf, -1.0]), torch.tensor([math.inf, -1.0]))
        mode, _ = goal_model.goal_action(state.features, code)  # not rounded to bfloat16, as `policy` is
        assert torch.allclose(proposals[::4, 0], mode, atol=1e-4)
        assert torch.allclose(proposals[8:12], alone, atol=1e-2)  # independent of the other states of the call


def test_untrained_goal_actor_acts_like_the_task_actor(model, state):
    torch.manual_seed(2)
    fresh = WorldModel(model.config, 3, LABELS, goal_dim=16)
    fresh.load_state_dict(model.state_dict(), strict=False)
    with torch.no_grad():
        fresh.goal_heads.actor.mlp.output.weight.zero_()
        assert torch.equal(BoxView(GOAL, 2)(fresh).policy(state), model.policy(state))


def test_box_view_value_and_policy_depend_on_the_box(goal_model, state):
    views = [BoxView(box, 2)(goal_model) for box in ({}, GOAL, {"speed": (3.0, math.inf)})]
    with torch.no_grad():
        for method in ("value", "policy"):
            results = [getattr(view, method)(state) for view in views]
            assert not any(torch.allclose(results[i], results[j]) for i, j in ((0, 1), (0, 2), (1, 2)))


def test_plan_for_a_box_accepts_constraints(goal_model, state):
    planner = CEMPlanner(action_dim=3, horizon=3, num_samples=16, num_elites=4, num_policy_samples=4)
    constraint = build_constraint(parse_constraints("height < 0.3", LABELS))
    plan = planner.plan(goal_model, state, objective=conditioned(BoxView(GOAL, 2)), constraints=[constraint])
    assert plan.actions.shape == (5, 3, 3) and plan.info["violation"].shape == (5,)
