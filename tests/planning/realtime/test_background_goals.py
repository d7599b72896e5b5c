"""Goals of a background planner: they are pickled, can change between requests, and are refused if not picklable."""

import pickle
from typing import NamedTuple

import pytest
import torch

from latentplan.planning import BackgroundPlanner, CEMPlanner, FunctionModel, PlanScheduler, conditioned, rate_limit
from latentplan.planning.objectives import (
    action_penalty,
    at_every_state,
    goal_term,
    learned_return,
    risk,
    smoothness_penalty,
)
from tests.planning.realtime.integrator import dynamics, policy, reward, wait_for_plan

STATE = torch.tensor([[1.0]])
CEM = CEMPlanner(action_dim=1, horizon=4, num_samples=16, num_elites=4, num_iterations=2)


def to_the_left(state):
    return state[:, 0] - STATE[0, 0]


def refuse():
    raise ValueError("not here")


class Unreadable:
    """An objective that can be pickled, but not unpickled."""

    def __reduce__(self):
        return refuse, ()


MODEL = FunctionModel(dynamics, reward)


@pytest.fixture(scope="module")
def process():
    """A background planner in a process that is ready; shared, because a process imports torch first."""
    with BackgroundPlanner(CEM, MODEL) as background:
        assert background.wait_until_ready(60.0)
        yield background


TERMS = (
    learned_return() + 0.5 * action_penalty(),
    -1.0 * goal_term(torch.tensor([2.0])) * 2.0 - smoothness_penalty(),
    goal_term(torch.tensor([2.0]), over="sum", metric="cosine"),
    risk(learned_return(), num_particles=1),
)


@pytest.mark.parametrize("term", TERMS)
def test_composed_terms_give_the_same_plan_after_pickling(term):
    arrived = pickle.loads(pickle.dumps(term))
    plans = [
        CEM.plan(MODEL, STATE, objective=objective, generator=torch.Generator().manual_seed(0))
        for objective in (term, arrived)
    ]
    assert torch.equal(plans[0].actions, plans[1].actions)


def check_changes(background):
    constraint = at_every_state(to_the_left)

    def expected(**goals):
        return CEM.plan(MODEL, STATE, generator=torch.Generator().manual_seed(3), **goals).actions

    for goals in ({}, {"objective": goal_term(torch.tensor([9.0]))}, {"constraints": [constraint]}, {}):
        background.set_objective(**goals)
        for tick in (1, 2):
            assert background.request(STATE, tick, seed=3)
            torch.testing.assert_close(wait_for_plan(background)[1].actions, expected(**goals))


def test_set_objective_takes_effect_at_the_next_request_in_a_process(process):
    check_changes(process)


def test_set_objective_takes_effect_at_the_next_request_in_a_thread():
    with BackgroundPlanner(CEM, MODEL, worker="thread") as background:
        check_changes(background)


def test_set_objective_refuses_goals_that_cannot_be_pickled_and_keeps_the_old_ones(process):
    goal = goal_term(torch.tensor([9.0]))
    process.set_objective(goal)
    with pytest.raises(TypeError, match="worker='thread'"):
        process.set_objective(lambda rollout: rollout.rewards.sum(1))
    process.request(STATE, 1, seed=3)
    kept = CEM.plan(MODEL, STATE, objective=goal, generator=torch.Generator().manual_seed(3))
    torch.testing.assert_close(wait_for_plan(process)[1].actions, kept.actions)


def test_poll_raises_until_goals_change_when_the_process_cannot_unpickle_them(process):
    process.set_objective(Unreadable())
    for tick in (1, 2):
        process.request(STATE, tick, seed=3)
        with pytest.raises(ValueError, match="not here"):
            wait_for_plan(process)
    process.set_objective()
    process.request(STATE, 3, seed=3)
    assert wait_for_plan(process)[0] == 3


class UnreadableState(NamedTuple):
    """A state that can be pickled, but not unpickled."""

    x: torch.Tensor

    def __reduce__(self):
        return refuse, ()


def test_goals_reach_the_search_after_a_request_that_could_not_be_read(process):
    goal = goal_term(torch.tensor([9.0]))
    process.set_objective(goal)
    process.request(UnreadableState(STATE), 1)
    with pytest.raises(ValueError, match="not here"):
        wait_for_plan(process)
    process.request(STATE, 2, seed=3)
    expected = CEM.plan(MODEL, STATE, objective=goal, generator=torch.Generator().manual_seed(3))
    torch.testing.assert_close(wait_for_plan(process)[1].actions, expected.actions)
    process.set_objective()


def towards_zero(state, generator):
    return -state


def test_scheduler_holds_a_rate_limit_that_the_background_planner_was_made_with():
    model = FunctionModel(dynamics, reward, policy=towards_zero)
    with BackgroundPlanner(CEM, model, constraints=[rate_limit(0.1)], worker="thread") as background:
        scheduler = PlanScheduler(CEM, model, background)
        actions = torch.cat([scheduler.decide(sign * STATE).action for sign in (1.0, -1.0, 1.0, -1.0)])
    assert (actions.diff(dim=0).abs() <= 0.1 + 1e-6).all()


def test_scheduler_acts_by_the_goal_that_the_background_planner_was_made_with():
    model = FunctionModel(dynamics, reward, policy=towards_zero)
    goal = conditioned(lambda _: FunctionModel(dynamics, reward, value=lambda state: state[:, 0], policy=policy))
    with BackgroundPlanner(CEM, model, objective=goal, worker="thread") as background:
        assert torch.equal(PlanScheduler(CEM, model, background).decide(STATE).action, policy(STATE, None))
        background.set_objective()
        assert background.objective is None and background.constraints == ()


def test_scheduler_follows_goals_that_the_background_planner_is_given_directly():
    """The policy of the goal goes right and the model's own goes left, as far as the rate limit lets it."""
    model = FunctionModel(dynamics, reward, policy=towards_zero)
    goal = conditioned(lambda _: FunctionModel(dynamics, reward, value=lambda state: state[:, 0], policy=policy))
    with BackgroundPlanner(CEM, model, worker="thread") as background:
        scheduler = PlanScheduler(CEM, model, background)
        assert not torch.equal(scheduler.decide(STATE).action, policy(STATE, None))
        scheduler.reset()
        background.set_objective(goal)
        assert torch.equal(scheduler.decide(STATE).action, policy(STATE, None))
        background.set_objective(constraints=[rate_limit(0.1)])
        actions = torch.cat([scheduler.decide(sign * STATE).action for sign in (1.0, -1.0, 1.0)])
    assert (actions.diff(dim=0).abs() <= 0.1 + 1e-6).all()
