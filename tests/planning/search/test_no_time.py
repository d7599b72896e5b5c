"""Plans of a search that has no time for one iteration."""

from dataclasses import replace

import pytest
import torch

from latentplan.planning import CEMPlanner, FunctionModel, conditioned, rate_limit

HORIZON = 4


class SlowModel:
    """A pull to the origin; a rollout takes 10 ms of its own time, a decision of its policy 1 ms."""

    def __init__(self):
        self.seconds = 100.0

    def step(self, state, action):
        following = state + 0.3 * action
        return following, -following.square().sum(dim=1)

    def rollout(self, state, actions):
        self.seconds += 0.01
        rewards = []
        for action in actions.unbind(1):
            state, reward = self.step(state, action)
            rewards.append(reward)
        return torch.stack(rewards, dim=1), state

    def policy(self, state, generator=None):
        self.seconds += 0.001
        return 0.25 + 0.1 * state


def first_reward(rollout):
    return rollout.rewards[:, 0]


@pytest.fixture
def model():
    return SlowModel()


@pytest.fixture
def state():
    return torch.tensor([[1.0, -1.0], [0.5, 2.0]])


@pytest.fixture
def planner(model):
    sizes = {"horizon": HORIZON, "num_samples": 32, "num_elites": 4, "num_policy_samples": 1}
    plain = {"final": "mean", "noise_beta": 0.0, "keep_elite_fraction": 0.0}
    return CEMPlanner(action_dim=2, **sizes, **plain, clock=lambda: model.seconds)


@pytest.fixture
def last(planner, model, state):
    """The last plan of a planner that has measured 4 ms for the policy's proposals and 10 ms for an iteration."""
    planner.plan(model, state)
    return planner.plan(model, state)


def test_policy_sequence_is_executed_when_no_iteration_fits(planner, model, state, last):
    before = model.seconds
    plan = planner.plan(model, state, last, deadline_ms=9)
    assert 1000 * (model.seconds - before) <= 9
    assert plan.info["is_fallback"].all() and plan.info["stopped"] == "deadline"
    assert plan.source == "actor" and last.source == "plan"
    assert torch.allclose(plan.action, (0.25 + 0.1 * state).clamp(-1.0, 1.0))


def test_policy_of_a_learned_goal_is_executed_when_no_iteration_fits(planner, model, state, last):
    own = planner.plan(model, state, last, deadline_ms=5.0)
    plan = planner.plan(model, state, last, objective=conditioned(lambda seen: seen), deadline_ms=5.0)
    assert plan.info["stopped"] == "deadline" and bool(plan.info["is_policy"].all())
    assert torch.equal(plan.actions, own.actions)


def test_pace_separates_models_of_different_types(planner, model, state, last):
    class Slower(SlowModel):
        def rollout(self, state, actions):
            model.seconds += 0.09
            return super().rollout(state, actions)

    for _ in range(9):
        planner.plan(model, state, objective=conditioned(lambda _: Slower()))
    assert planner.plan(model, state, last, deadline_ms=25).info["iterations"].tolist() == [2, 2]


@pytest.mark.parametrize("previous", ["last", None])
def test_policy_action_is_held_when_its_sequence_does_not_fit(planner, model, state, last, previous):
    before = model.seconds
    plan = planner.plan(model, state, last if previous else None, deadline_ms=0)
    assert 1000 * (model.seconds - before) <= 1.001
    assert plan.source == "actor" and plan.info["is_fallback"].all()
    assert torch.allclose(plan.actions, (0.25 + 0.1 * state).clamp(-1.0, 1.0)[:, None].expand(-1, HORIZON, -1))


def test_last_plan_is_executed_without_time_and_policy(planner, model, state, last):
    shifted = replace(planner, num_policy_samples=0).plan(model, state, last, deadline_ms=0)
    assert shifted.source == "tail"
    assert torch.equal(shifted.actions[:, :-1], last.actions[:, 1:])


@pytest.mark.parametrize("wanted", [{"objective": first_reward}, {"constraints": [first_reward]}])
def test_last_plan_is_executed_without_time_when_another_objective_is_set(planner, model, state, last, wanted):
    plan = planner.plan(model, state, last, deadline_ms=9, **wanted)
    assert torch.equal(plan.actions[:, :-1], last.actions[:, 1:])


def test_last_plan_is_executed_without_time_when_the_policy_is_nan(planner, model, state, last):
    model.policy = lambda state, generator=None: torch.full_like(state, float("nan"))
    plan = planner.plan(model, state, last, deadline_ms=9)
    assert torch.equal(plan.actions[:, :-1], last.actions[:, 1:])


@pytest.mark.parametrize("is_reset", [False, True])
def test_rate_limit_holds_after_a_cold_start_that_had_no_time(make_planner, is_reset):
    limits = [rate_limit(0.1)]
    model = FunctionModel(lambda state, action: state + action, lambda state, action: action.sum(1))
    planner, state = make_planner(), torch.zeros(2, 2)
    first = planner.plan(model, state, constraints=limits, deadline_ms=0.0)
    assert bool(first.info["is_fallback"].all()) and not bool(first.is_warm.any())
    if is_reset:  # of the second environment, which has no action before its first
        first = first.forget(torch.tensor([False, True]))
    second = planner.plan(model, state, first, constraints=limits)
    change = (second.action - first.action).abs().amax(1)
    assert change[0] <= 0.1 + 1e-6
    assert bool(change[1] > 0.5) == is_reset
