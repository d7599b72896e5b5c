"""The sequence that is executed: the mean, the best candidate or the policy's mode."""

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


def returns_of(model, state, actions):
    """The true return of sequences (batch, horizon, action), with a discount of 1 and without a value."""
    total = torch.zeros(len(state))
    for action in actions.unbind(dim=1):
        total = total + model.reward(state, action)
        state = model.dynamics(state, action)
    return total


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


@pytest.mark.parametrize("final", ["mean", "best", "better"])
@pytest.mark.parametrize("margin", [0.0, 0.05, 0.5, 1e6])
def test_policy_is_executed_where_the_plan_does_not_gain_the_margin(make_planner, seeded, final, margin):
    states = torch.tensor([[0.2], [-0.4], [0.3], [0.0]])
    share = torch.tensor([1.0, 0.97, 0.8, 0.4])  # of the largest action, by the policy

    def policy(state, generator):
        return share[torch.bucketize(state, states.flatten().sort().values)].expand(len(state), 2)

    model = make_model(policy, lambda state, action: action.sum(dim=1))
    plain, planner = (make_planner(num_policy_samples=1, final=final, policy_margin=each) for each in (None, margin))
    chosen, plan = (each.plan(model, states, generator=seeded()) for each in (plain, planner))
    torch.testing.assert_close(plan.mean, chosen.mean)  # the search itself is the same
    mode = policy(states, None)[:, None].expand_as(plan.actions)
    gains = returns_of(model, states, chosen.actions) - returns_of(model, states, mode)
    is_enough = gains > margin * returns_of(model, states, mode).abs()
    torch.testing.assert_close(plan.actions, torch.where(is_enough[:, None, None], chosen.actions, mode))
    torch.testing.assert_close(plan.expected_return, returns_of(model, states, plan.actions))


@pytest.mark.parametrize(
    "given", [{"objective": learned_return()}, {"constraints": [lambda rollout: rollout.rewards[:, 0] * 0.0]}]
)
def test_policy_replaces_no_plan_for_what_it_was_not_trained_for(make_planner, seeded, given):
    model, states = make_model(constant(0.3)), torch.tensor([[0.2], [-0.4]])
    plain, planner = (make_planner(num_policy_samples=1, policy_margin=each) for each in (None, 1e6))
    plans = [each.plan(model, states, generator=seeded(), **given) for each in (plain, planner)]
    torch.testing.assert_close(plans[0].actions, plans[1].actions)


def test_policy_that_is_not_finite_replaces_no_plan(make_planner, seeded):
    def reward(state, action):
        return torch.nan_to_num(action, nan=9.0).sum(dim=1)

    model = make_model(constant(NAN), reward)
    plan = make_planner(num_policy_samples=4, policy_margin=1e6, final="mean").plan(
        model, torch.zeros(2, 1), generator=seeded()
    )
    torch.testing.assert_close(plan.actions, plan.mean)


@pytest.mark.parametrize("policy", [NAN, 5.0])
def test_final_better_ignores_a_nan_mode_and_clamps_one_out_of_bounds(make_planner, seeded, policy):
    def reward(state, action):
        return torch.nan_to_num(action, nan=9.0).sum(dim=1)

    plan = make_planner(num_policy_samples=4, final="better").plan(
        make_model(constant(policy), reward), torch.zeros(2, 1), generator=seeded()
    )
    expected = plan.mean if math.isnan(policy) else torch.ones_like(plan.mean)
    torch.testing.assert_close(plan.actions, expected)


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"objective": learned_return()},
        {"constraints": [lambda rollout: rollout.rewards[:, 0] * 0.0]},
        {"constraints": [lambda rollout: rollout.actions[:, 0, 0] + 0.5]},
    ],
)
def test_final_better_executes_the_better_of_mean_and_best_candidate(point, states, make_planner, seeded, given):
    """Without a policy that may replace the plan; the expected return is that of the sequence that is executed."""
    model = FunctionModel(point.dynamics, point.reward)

    def plan(final):
        planner = make_planner(final=final, num_elites=16, num_iterations=2)
        return planner.plan(model, states, generator=seeded(), **given)

    mean, best, better = (plan(final) for final in ("mean", "best", "better"))
    is_mean = (better.actions == better.mean).flatten(1).all(dim=1)
    is_best = (better.actions == best.actions).flatten(1).all(dim=1)
    assert (is_mean | is_best).all()
    torch.testing.assert_close(better.expected_return, returns_of(model, states, better.actions), atol=1e-4, rtol=1e-5)
    if "constraints" not in given:
        others = [returns_of(model, states, other.actions) for other in (mean, best)]
        assert (better.expected_return >= torch.maximum(*others) - 1e-4).all()
    else:
        assert (better.info["violation"] <= best.info["violation"] + 1e-6).all()


def test_final_better_avoids_a_mean_that_runs_through_the_obstacle(make_planner, seeded):
    """Both sides of the obstacle at 0 are good, and their mean is not."""
    model = FunctionModel(lambda state, action: state, lambda state, action: -torch.exp(-50 * action[:, 0].square()))
    sizes = {"num_iterations": 1, "num_elites": 32, "smoothing": 1.0, "horizon": 1}
    through, around = (
        make_planner(final=final, **sizes).plan(model, torch.zeros(20, 1), generator=seeded())
        for final in ("mean", "better")
    )
    assert (through.action[:, 0].abs() < 0.15).all() and (around.action[:, 0].abs() > 0.3).all()
    assert (through.expected_return > returns_of(model, torch.zeros(20, 1), through.actions) + 0.5).all()
    torch.testing.assert_close(around.expected_return, returns_of(model, torch.zeros(20, 1), around.actions))


def test_final_better_executes_the_last_plan_when_no_return_is_finite(point, states, make_planner, seeded):
    planner = make_planner(num_policy_samples=4, final="better")
    last = planner.plan(point, states, generator=seeded())
    broken = make_model(point.policy, lambda state, action: torch.full_like(state[:, 0], NAN))
    plan = planner.plan(broken, states, last, generator=seeded())
    assert plan.info["is_fallback"].all() and plan.expected_return.isnan().all()
    torch.testing.assert_close(plan.actions[:, :-1], last.actions[:, 1:])
