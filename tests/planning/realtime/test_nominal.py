"""The policy corrects a planned action by the difference between the real and the predicted state."""

import pytest
import torch

from latentplan.planning import CEMPlanner, FunctionModel, PlanScheduler, rate_limit
from latentplan.planning.realtime.scheduler import NominalTrajectory
from tests.planning.realtime.integrator import dynamics, reward

GAIN = -0.5
PLAN = torch.tensor([[[0.4], [-0.2], [0.1]], [[0.0], [0.3], [0.9]]])
START = torch.tensor([[1.0], [-2.0]])


def no_reward(state, action):
    return torch.zeros(len(state))


def linear(state, generator=None):
    return GAIN * state


@pytest.fixture
def nominal():
    return NominalTrajectory(FunctionModel(dynamics, no_reward, policy=linear), START, PLAN)


def test_nominal_trajectory_has_the_states_of_the_plan(nominal):
    for age in (2, 0, 1, 3):
        torch.testing.assert_close(nominal.state_at(age), START + PLAN[:, :age].sum(dim=1))


@pytest.mark.parametrize("age", [0, 1, 2])
def test_nominal_trajectory_keeps_the_plan_when_the_state_is_as_predicted(nominal, age):
    torch.testing.assert_close(nominal.correct(age, nominal.state_at(age), linear), PLAN[:, age])


@pytest.mark.parametrize("age", [0, 2])
def test_nominal_trajectory_adds_the_policys_difference(nominal, age):
    push = torch.tensor([[0.3], [-0.7]])
    corrected = nominal.correct(age, nominal.state_at(age) + push, linear)
    torch.testing.assert_close(corrected, PLAN[:, age] + GAIN * push)


def test_nominal_trajectory_keeps_the_plan_when_the_policy_is_nan(nominal):
    def broken(state):
        return torch.where(state > 5.0, float("nan"), linear(state))

    corrected = nominal.correct(0, START + torch.tensor([[9.0], [1.0]]), broken)
    torch.testing.assert_close(corrected, PLAN[:, 0] + torch.tensor([[0.0], [GAIN]]))


class OnePlan:
    """An executor that returns a plan at the tick after each request."""

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
    """Mean distance from the goal, and actions, of a body that is pushed at every tick."""
    planner = CEMPlanner(action_dim=1, horizon=4, num_samples=256, num_elites=16, num_iterations=6)
    scheduler = PlanScheduler(planner, model, OnePlan(planner, model))
    state, distances, actions = torch.tensor([[1.0]]), [], []
    noise = torch.Generator().manual_seed(1)
    for _ in range(ticks):
        actions.append(scheduler.decide(state).action)
        state = dynamics(state, actions[-1]) + push * torch.randn(1, 1, generator=noise)
        distances.append(state.abs().item())
    return sum(distances[5:]) / len(distances[5:]), torch.cat(actions)


def test_policy_correction_keeps_a_pushed_body_nearer_to_its_goal():
    """The plan for a tick is made before the last push, and the policy sees the state after the push."""

    def towards_zero(state, generator):
        return -state

    alone, _ = drive(FunctionModel(dynamics, reward), push=0.2)
    held, actions = drive(FunctionModel(dynamics, reward, policy=towards_zero), push=0.2)
    assert held < 0.85 * alone
    assert actions.abs().max() <= 1.0


def decide(model, planner, states, ticks=6, **settings):
    """Actions, (tick, batch, action), of a scheduler that plans from the second tick on."""
    scheduler = PlanScheduler(planner, model, OnePlan(planner, model))
    if settings:
        scheduler.executor.set_objective = lambda objective, constraints: None
        scheduler.set_objective(**settings)
    return torch.stack([scheduler.decide(states).action for _ in range(ticks)])


@pytest.mark.parametrize("bounds", [("low",), ("low", "high")])
def test_corrected_actions_keep_the_bounds_of_each_environment(bounds):
    low, high = torch.tensor([-0.2, -0.4])[:, None, None], torch.tensor([0.1, 0.3])[:, None, None]
    options = {"action_low": low} | ({"action_high": high} if "high" in bounds else {})
    planner = CEMPlanner(action_dim=1, horizon=4, num_samples=32, num_elites=4, **options)
    actions = decide(FunctionModel(dynamics, reward, policy=linear), planner, START)
    assert (actions >= low[:, 0] - 1e-6).all() and (actions <= (high if "high" in bounds else low + 9)[:, 0]).all()


def test_rate_limit_holds_between_policy_plans_and_corrections():
    """The state never becomes what the model predicts, so that the policy corrects every action."""
    planner = CEMPlanner(action_dim=1, horizon=4, num_samples=32, num_elites=4)
    model = FunctionModel(dynamics, reward, policy=linear)
    actions = decide(model, planner, START, objective=None, constraints=[rate_limit(0.1)])
    assert (actions.diff(dim=0).abs() <= 0.1 + 1e-6).all()
    assert (decide(model, planner, START).diff(dim=0).abs() > 0.1 + 1e-6).any()


def test_scheduler_steps_a_model_that_requires_a_generator():
    def noisy(state, action, generator):
        return state + action + 0.01 * torch.randn(state.shape, generator=generator)

    planner = CEMPlanner(action_dim=1, horizon=4, num_samples=32, num_elites=4)
    assert torch.isfinite(decide(FunctionModel(noisy, reward, policy=linear), planner, START)).all()
