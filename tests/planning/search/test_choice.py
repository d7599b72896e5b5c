"""`final="better"` executes the mean or the policy's mode, by predicted return."""

import math

import pytest
import torch

from latentplan.planning import FunctionModel, learned_return

NAN = float("nan")


def spiked_reward(state, action):
    """A low maximum where the action equals the state, and a high reward at exactly 0.625."""
    return 1 - (action - state[:, :1]).square().sum(dim=1) + 10 * (action - 0.625).abs().amax(dim=1).lt(1e-6).float()


def make_model(policy, reward=spiked_reward):
    return FunctionModel(lambda state, action: state, reward, policy=policy)


def constant(number):
    return lambda state, generator: torch.full((len(state), 2), number)


def test_final_better_executes_mean_or_policy_mode_by_return(make_planner, seeded):
    states = torch.tensor([[0.2], [-0.4], [0.3]])
    good = torch.tensor([[0.2], [0.3]])  # states in which the policy takes the action of the high reward
    model = make_model(lambda state, generator: torch.where(torch.isin(state, good), 0.625, 0.0).expand(len(state), 2))
    plain, planner = (make_planner(num_policy_samples=1, final=final) for final in ("mean", "better"))
    mean, plan = (each.plan(model, states, generator=seeded()) for each in (plain, planner))
    torch.testing.assert_close(plan.mean, mean.mean)  # the search itself is the same
    torch.testing.assert_close(plan.actions[0::2], torch.full_like(plan.actions[0::2], 0.625))
    torch.testing.assert_close(plan.actions[1], plan.mean[1])
    rewards = [spiked_reward(states, action) for action in plan.actions.unbind(dim=1)]  # the discount is 1
    torch.testing.assert_close(plan.expected_return, sum(rewards))


@pytest.mark.parametrize("policy", [NAN, 5.0])
def test_final_better_ignores_a_nan_mode_and_clamps_one_out_of_bounds(make_planner, seeded, policy):
    def reward(state, action):
        return torch.nan_to_num(action, nan=9.0).sum(dim=1)

    plan = make_planner(num_policy_samples=4, final="better").plan(
        make_model(constant(policy), reward), torch.zeros(2, 1), generator=seeded()
    )
    expected = plan.mean if math.isnan(policy) else torch.ones_like(plan.mean)
    torch.testing.assert_close(plan.actions, expected)


def test_final_better_is_mean_when_the_policy_makes_no_valid_proposal(make_planner, seeded):
    model, states = make_model(constant(0.625)), torch.tensor([[0.2], [-0.4]])
    planner = make_planner(num_policy_samples=4, final="better")
    for given in ({"objective": learned_return()}, {"constraints": [lambda rollout: rollout.rewards[:, 0] * 0.0]}):
        plan = planner.plan(model, states, generator=seeded(), **given)
        assert torch.equal(plan.actions, plan.mean)
    alone = make_planner(final="better").plan(model, states, generator=seeded())
    assert torch.equal(alone.actions, alone.mean)


def test_final_better_executes_the_last_plan_when_no_return_is_finite(point, states, make_planner, seeded):
    planner = make_planner(num_policy_samples=4, final="better")
    last = planner.plan(point, states, generator=seeded())
    broken = make_model(point.policy, lambda state, action: torch.full_like(state[:, 0], NAN))
    plan = planner.plan(broken, states, last, generator=seeded())
    assert plan.info["is_fallback"].all() and plan.expected_return.isnan().all()
    torch.testing.assert_close(plan.actions[:, :-1], last.actions[:, 1:])
