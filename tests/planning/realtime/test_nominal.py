"""A plan in a world that does not go as planned: the policy answers the difference, and nothing else."""

import pytest
import torch

from latentplan.planning import CEMPlanner, FunctionModel, PlanScheduler
from latentplan.planning.realtime.scheduler import NominalTrajectory

GAIN = -0.5
PLAN = torch.tensor([[[0.4], [-0.2], [0.1]], [[0.0], [0.3], [0.9]]])
START = torch.tensor([[1.0], [-2.0]])


def dynamics(state, action):
    return state + action


def no_reward(state, action):
    return torch.zeros(len(state))


def linear(state, generator=None):
    return GAIN * state


@pytest.fixture
def nominal():
    return NominalTrajectory(FunctionModel(dynamics, no_reward, policy=linear), START, PLAN)


def test_states_are_those_that_the_actions_lead_to(nominal):
    for age in (2, 0, 1, 3):
        torch.testing.assert_close(nominal.state_at(age), START + PLAN[:, :age].sum(dim=1))


@pytest.mark.parametrize("age", [0, 1, 2])
def test_where_the_world_goes_as_imagined_the_plan_stands(nominal, age):
    torch.testing.assert_close(nominal.correct(age, nominal.state_at(age), linear), PLAN[:, age])


@pytest.mark.parametrize("age", [0, 2])
def test_the_policy_answers_the_difference(nominal, age):
    push = torch.tensor([[0.3], [-0.7]])
    corrected = nominal.correct(age, nominal.state_at(age) + push, linear)
    torch.testing.assert_close(corrected, PLAN[:, age] + GAIN * push)


def test_where_the_policy_is_not_finite_the_plan_stands(nominal):
    def broken(state):
        return torch.where(state > 5.0, float("nan"), linear(state))

    corrected = nominal.correct(0, START + torch.tensor([[9.0], [1.0]]), broken)
    torch.testing.assert_close(corrected, PLAN[:, 0] + torch.tensor([[0.0], [GAIN]]))


class OnePlan:
    """Gives the same plan for whatever tick it is asked for, at the next tick."""

    def __init__(self, planner, model):
        self.planner, self.model, self.work = planner, model, None

    @property
    def is_idle(self):
        return self.work is None

    def request(self, state, tick, previous=None, seed=None):
        self.work = (tick, self.planner.plan(self.model, state, generator=torch.Generator().manual_seed(0)))
        return True

    def poll(self):
        work, self.work = self.work, None
        return work


def drive(model, push, ticks=40):
    """Where a body ends that is pushed at every tick, planned for beside the loop: (mean distance, actions)."""
    planner = CEMPlanner(action_dim=1, horizon=4, num_samples=256, num_elites=16, num_iterations=6)
    scheduler = PlanScheduler(planner, model, OnePlan(planner, model))
    state, distances, actions = torch.tensor([[1.0]]), [], []
    noise = torch.Generator().manual_seed(1)
    for _ in range(ticks):
        actions.append(scheduler.decide(state).action)
        state = dynamics(state, actions[-1]) + push * torch.randn(1, 1, generator=noise)
        distances.append(state.abs().item())
    return sum(distances[5:]) / len(distances[5:]), torch.cat(actions)


def test_a_pushed_body_stays_nearer_to_where_it_should_be():
    """The plan for a tick knows nothing of the last push; the policy does."""

    def reward(state, action):
        return -(state + action).square().sum(dim=1)

    def towards_zero(state, generator):
        return -state

    alone, _ = drive(FunctionModel(dynamics, reward), push=0.2)
    held, actions = drive(FunctionModel(dynamics, reward, policy=towards_zero), push=0.2)
    assert held < 0.85 * alone
    assert actions.abs().max() <= 1.0
