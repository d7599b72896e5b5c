"""The planning agent: plans, pictures, deadlines, and the actor in place of plans from surprising frames."""

import dataclasses

import numpy as np
import pytest
import torch

from latentplan.agents.actor import ActorAgent
from latentplan.agents.planning import PlanningAgent
from latentplan.models import State
from latentplan.planning import rate_limit
from tests.agents.small_agents import CONFIG, make_model


def limit_first_action(rollout):
    """A constraint: the sum of the absolute values of the first action is at most 0.1."""
    return rollout.actions[:, 0].abs().sum(-1) - 0.1


GOALS = [{"objective": lambda rollout: rollout.actions[:, 0, 0]}, {"constraints": [limit_first_action]}]


@pytest.fixture(scope="module")
def model():
    return make_model()


@pytest.fixture
def frames(film):
    """Frames of two environments."""
    return film[0, :2]


def make_planner(model, **settings):
    return PlanningAgent(model, CONFIG, 0.9, planner=dataclasses.replace(CONFIG.planner, **settings))


def test_masked_reset_forgets_the_plans_of_masked_environments_only(model, film):
    agent = make_planner(model)
    agent.act(film[0])
    agent.reset(np.array([False, True, False]))
    assert agent.controller.plan.is_warm.tolist() == [True, False, True]


def test_imagine_gives_a_picture_when_there_is_a_plan(model, film):
    agent = make_planner(model)
    assert agent.imagine() is None
    agent.act(film[0])
    picture = agent.imagine()
    assert picture.shape == (32, 32, 3) and picture.dtype == np.uint8
    agent.reset()
    assert agent.imagine() is None


def test_planning_agent_acts_by_the_actor_when_the_deadline_is_too_short(model, film):
    agent, actor = make_planner(model, deadline_ms=1e5), ActorAgent(model, CONFIG)
    for frame in film[:3, 0]:
        agent.act(frame)
    assert agent.last_source == "plan"
    agent.reset()
    pace = agent.controller.planner.pace
    for key in [key for key in pace._durations if key[0] == "iteration"]:
        for _ in range(33):
            pace.record(key, 1e3)  # seconds
    assert np.allclose(agent.act(film[0, 0]), actor.act(film[0, 0]), atol=0.02) and agent.last_source == "actor"


def test_surprise_is_half_the_squared_distance_in_standard_deviations(model):
    deter = torch.randn(2, 16, generator=torch.Generator().manual_seed(0))
    prior = model.dynamics.prior(deter)
    away = prior.std * torch.tensor([[0.0], [2.0]]) * (torch.arange(32) == 5)
    assert torch.allclose(model.surprise(State(deter, prior.mean + away)), torch.tensor([0.0, 2.0]), atol=1e-4)


@pytest.mark.parametrize("limit", [5.0, 1.0, 0.5])
def test_planning_agent_acts_by_the_actor_when_a_frame_exceeds_the_surprise_limit(model, frames, monkeypatch, limit):
    surprise = torch.tensor([3.0, 0.7])
    monkeypatch.setattr(type(model.backend.frame_functions(model)), "surprise", lambda self, state: surprise)
    planner, actor = make_planner(model, num_policy_samples=0), ActorAgent(model, CONFIG)
    limited = make_planner(model, num_policy_samples=0, surprise_limit=limit)
    planned, acted, action = (agent.act(frames) for agent in (planner, actor, limited))
    assert not np.allclose(planned, acted, atol=0.05)
    for row in range(2):
        expected = acted if surprise[row] > limit else planned
        assert np.allclose(action[row], expected[row], atol=0.02)
    is_surprised = bool(surprise[0] > limit)
    assert (limited.imagine() is None) == is_surprised
    assert limited.last_source == ("actor" if is_surprised else "plan") and limited.was_surprised == is_surprised


@pytest.mark.parametrize("goals", GOALS)
def test_planning_agent_ignores_surprise_when_an_objective_or_constraint_is_set(model, frames, goals):
    planner = make_planner(model)
    limited = make_planner(model, surprise_limit=1e-6)
    assert planner.effective_surprise_limit is None and limited.effective_surprise_limit == 1e-6
    for agent in (planner, limited):
        agent.set_objective(**goals)
        assert agent.effective_surprise_limit is None
    assert np.array_equal(planner.act(frames[0]), limited.act(frames[0])) and limited.last_source == "plan"


@pytest.mark.parametrize("broken", [0, 1])
def test_failed_search_of_any_environment_is_warned_of(model, frames, broken):
    agent = make_planner(model)
    agent.act(frames)
    state = State(*(part.clone() for part in agent.state))
    state.deter[broken] = float("nan")
    agent.state = state
    with pytest.warns(RuntimeWarning, match="a search found nothing finite"):
        agent.act(frames)


@pytest.mark.parametrize("settings", [{"surprise_limit": 1e-6}, {"noise_std": 0.5}])
def test_rate_limit_counts_from_the_executed_action_whoever_chose_it(model, frames, settings):
    noise = settings.pop("noise_std", 0.0)
    agent = make_planner(model, **settings)
    agent.noise_std = noise
    agent.act(frames)
    before = agent.act(frames)
    agent.noise_std = 0.0
    agent.set_objective(None, [rate_limit(0.05)])
    assert np.abs(agent.act(frames) - before).max() <= 0.05 + 1e-5
    agent.reset(np.array([True, False]))
    assert np.abs(agent.act(frames) - before)[1].max() <= 0.1 + 1e-5
