"""A search for a learned goal equals a search in a model that was trained for this goal."""

import pytest
import torch

from latentplan.planning import FunctionModel, PlanScheduler, conditioned
from latentplan.planning.objectives import action_penalty


def goal_dynamics(state, action):
    velocity = state[:, 2:] + 0.3 * action
    return torch.cat([state[:, :2] + 0.3 * velocity, velocity], dim=1)


def goal_policy(state, generator):
    mode = (1.0 - state[:, :2] - state[:, 2:]).clamp(-1.0, 1.0)
    return mode if generator is None else mode + 0.2 * torch.randn(mode.shape, generator=generator)


GOAL = FunctionModel(
    goal_dynamics,
    lambda state, action: -(state[:, :2] - 1.0).square().sum(dim=1),
    value=lambda state: -3.0 * (state[:, :2] - 1.0).square().sum(dim=1),
    policy=goal_policy,
)


def to_goal(model):
    return GOAL


def test_conditioned_gives_the_plan_of_a_model_trained_for_the_goal(point, states, make_planner, seeded):
    planner = make_planner(num_policy_samples=8, goal_horizon=9)
    plan = planner.plan(point, states, objective=conditioned(to_goal), generator=seeded())
    own = planner.plan(GOAL, states, generator=seeded())
    assert plan.actions.shape == (5, 6, 2)  # `horizon` steps, not `goal_horizon`, because the goal has a value
    assert torch.equal(plan.actions, own.actions) and torch.equal(plan.expected_return, own.expected_return)
    assert not torch.allclose(plan.actions, planner.plan(point, states, generator=seeded()).actions)


def test_conditioned_search_omits_the_goals_value_when_terminal_value_is_false(point, states, make_planner, seeded):
    plans = [
        make_planner(terminal_value=kept).plan(point, states, objective=conditioned(to_goal), generator=seeded())
        for kept in (True, False)
    ]
    assert not torch.allclose(plans[0].expected_return, plans[1].expected_return)


def test_conditioned_has_the_same_return_in_a_sum(point, states, make_planner, seeded):
    planner = make_planner(num_iterations=1)
    alone = planner.plan(point, states, objective=conditioned(to_goal), generator=seeded())
    summed = planner.plan(point, states, objective=conditioned(to_goal) + 0.0 * action_penalty(), generator=seeded())
    assert torch.allclose(alone.expected_return, summed.expected_return, atol=1e-4)


def noisy_dynamics(state, action, generator=None):
    moved = goal_dynamics(state, action)
    return moved + 0.3 * torch.randn(moved.shape, generator=generator)


def test_sum_repeats_in_a_model_that_samples_and_leaves_torchs_stream(states, make_planner, seeded):
    noisy = FunctionModel(noisy_dynamics, GOAL.reward, value=GOAL.value)
    objective = conditioned(lambda model: noisy) + 0.1 * action_penalty()
    before = torch.get_rng_state()
    plans = [make_planner().plan(noisy, states, objective=objective, generator=seeded()) for _ in range(2)]
    assert torch.equal(plans[0].actions, plans[1].actions)
    assert torch.equal(torch.get_rng_state(), before)


class Idle:
    """An executor that never has a plan."""

    is_idle = False

    def set_objective(self, objective=None, constraints=()):
        self.objective = objective

    def poll(self):
        return None


@pytest.mark.parametrize("is_goal", [False, True])
def test_scheduler_takes_the_goals_policy_when_there_is_no_plan(is_goal, point, states, make_planner):
    scheduler = PlanScheduler(make_planner(), point, Idle())
    scheduler.set_objective(conditioned(to_goal) if is_goal else None)
    decision = scheduler.decide(states)
    wanted = goal_policy(states, None) if is_goal else point.policy(states, None)
    assert decision.source == "actor" and torch.equal(decision.action, wanted.clamp(-1.0, 1.0))
    scheduler.set_objective(None)
    assert torch.equal(scheduler.decide(states).action, point.policy(states, None).clamp(-1.0, 1.0))
