"""The background agent: actions come from the newest plan that is due, else from the actor."""

import pickle
import time

import numpy as np
import pytest
import torch

from latentplan.agents.actor import ActorAgent
from latentplan.agents.background import BackgroundAgent
from latentplan.config import Config, PlannerConfig, UserError
from latentplan.models import WorldModel
from latentplan.planning import rate_limit
from tests.agents.small_agents import SIZES, make_plain_model

CONFIG = Config(
    model=SIZES,
    planner=PlannerConfig(horizon=4, num_samples=16, num_elites=4, num_iterations=2, num_policy_samples=2),
)


@pytest.fixture(scope="module")
def model():
    return make_plain_model()


@pytest.fixture
def film():
    """Twelve frames of three environments, (time, environment, 64, 64, 3)."""
    return np.random.default_rng(0).integers(0, 256, (12, 3, 64, 64, 3), dtype=np.uint8)


class Ticking:
    """An executor whose plans are ready after a given number of polls; the agent polls once per decision."""

    def __init__(self, planner, model, ticks):
        self.planner, self.model, self.ticks, self.polls, self.work = planner, model, ticks, 0, None
        self.goals = {}

    @property
    def is_idle(self):
        return self.work is None

    def set_objective(self, objective=None, constraints=()):
        self.goals = {"objective": objective, "constraints": constraints}

    def request(self, state, tick, previous=None, seed=None):
        generator = torch.Generator().manual_seed(seed)
        plan = self.planner.plan(self.model, state, previous, generator=generator, **self.goals)
        self.work = (self.polls + self.ticks, tick, plan)
        return True

    def poll(self):
        self.polls += 1
        if self.work is None or self.polls < self.work[0]:
            return None
        (_, tick, plan), self.work = self.work, None
        return tick, plan


def make(model, ticks=2, **options):
    return BackgroundAgent(
        model, CONFIG, 0.9, make_executor=lambda planner, model: Ticking(planner, model, ticks), **options
    )


def test_background_agent_acts_by_the_actor_until_the_first_plan_is_due(model, film):
    agent, actor = make(model), ActorAgent(model, CONFIG)
    history = []
    for frames in film:
        action = agent.act(frames[0])
        assert action.shape == (2,) and action.dtype == np.float32 and np.abs(action).max() <= 1.0
        history.append((agent.last_source, agent.plan_age))
        if len(history) <= 2:  # the background agent's actor computes in bfloat16
            assert np.allclose(action, actor.act(frames[0]), atol=0.02)
    assert history[:3] == [("actor", None), ("actor", None), ("plan", 1)]
    assert set(history[6:]) == {("plan", 0), ("plan", 1)}


def test_background_agent_plans_a_batch_together_and_drops_its_plans_at_a_masked_reset(model, film):
    agent = make(model)
    for frames in film[:6]:
        actions = agent.act(frames)
        assert actions.shape == (3, 2) and np.abs(actions).max() <= 1.0
    assert agent.last_source == "plan"
    agent.reset(np.array([False, True, False]))
    agent.act(film[6])
    assert agent.last_source == "actor"  # the plans of all environments are dropped
    assert agent.state.deter.shape == (3, 16)


def test_masked_reset_keeps_the_rate_limit_of_the_other_environments(model, film):
    agent, actions = make(model), []
    agent.set_objective(None, [rate_limit(0.002)])
    for number, frames in enumerate(film):
        if number == 6:
            agent.reset(np.array([False, True, False]))
        actions.append(agent.act(frames))
    changes = np.abs(np.diff(actions, axis=0)).max(-1)
    assert (changes[:, [0, 2]] <= 0.002 + 1e-6).all() and changes[5, 1] > 0.002


def test_reset_forgets_the_past_and_the_plans(model, film):
    agent, fresh = make(model), make(model)
    for frames in film[:5]:
        agent.act(frames[0])
    agent.reset()
    assert agent.imagine() is None
    assert np.array_equal(agent.act(film[7, 0]), fresh.act(film[7, 0]))


def test_act_repeats_with_the_seed(model, film):
    histories = []
    for seed in (5, 5, 6):
        agent = make(model)
        agent.seed(seed)
        histories.append(np.stack([agent.act(frames[0]) for frames in film]))
    assert np.array_equal(histories[0], histories[1])
    assert not np.array_equal(histories[0], histories[2])


def test_imagine_gives_a_picture_when_a_plan_is_in_use(model, film):
    agent = make(model)
    agent.act(film[0, 0])
    assert agent.imagine() is None
    for frames in film[1:5]:
        agent.act(frames[0])
    picture = agent.imagine()
    assert picture.shape == (32, 32, 3) and picture.dtype == np.uint8
    assert agent.encode(film[0, 0]).shape == (32,)


def test_act_keeps_a_pending_reset_when_a_decision_fails(model, film):
    agent, fresh = make(model), make(model)
    agent.act(film[0])
    agent.reset(np.array([True, True, True]))
    poll, agent.scheduler.executor.poll = agent.scheduler.executor.poll, lambda: 1 / 0
    with pytest.raises(ZeroDivisionError):
        agent.act(film[1])
    agent.scheduler.executor.poll = poll
    assert np.allclose(agent.act(film[1]), fresh.act(film[1]), atol=1e-5)


def test_set_objective_changes_to_the_actor_of_a_learned_goal_at_once(film):
    torch.manual_seed(0)
    model = WorldModel(CONFIG.model, action_dim=2, labels={"cart": 1.0}, goal_dim=8)
    with torch.no_grad():
        model.goal_heads.actor.mlp.output.weight.normal_(std=1.0)
    agent = make(model, ticks=50)
    agent.set_objective("cart > 100")
    goals = pickle.loads(pickle.dumps(agent.scheduler.executor.goals))
    action = agent.act(film[0, 0])
    with torch.no_grad():
        wanted = goals["objective"].view(model).policy(agent.state)[0]
    assert agent.last_source == "actor" and np.allclose(action, wanted.float(), atol=0.02)
    agent.reset()
    agent.set_objective()
    assert not np.allclose(agent.act(film[0, 0]), wanted.float(), atol=0.02)


def test_set_objective_changes_the_plans_and_not_the_actor(film):
    torch.manual_seed(0)
    model = WorldModel(CONFIG.model, action_dim=2, labels={"cart": 1.0})
    agents = [make(model), make(model)]
    agents[1].set_objective("cart > 100", constraints="cart > 50")
    goals = agents[1].scheduler.executor.goals
    sent = pickle.loads(pickle.dumps(goals["objective"]))  # as for a worker process
    assert len(goals["constraints"]) == 1 and set(sent.needs) == {"probe", "value"}
    first, later = [[agent.act(frames[0]) for agent in agents] for frames in film[:3]][::2]
    assert np.array_equal(*first) and not np.array_equal(*later)
    with pytest.raises(UserError, match="height"):
        agents[1].set_objective("height > 1")
    agents[1].set_objective()
    assert agents[1].scheduler.executor.goals == {"objective": None, "constraints": ()}


@pytest.mark.parametrize("worker", ["process", "thread"])
def test_background_agent_gets_plans_from_a_real_worker(model, film, worker):
    with BackgroundAgent(model, CONFIG, 0.9, worker=worker) as agent:
        assert agent.wait_until_ready()
        sources = set()
        for index in range(2000):
            agent.act(film[index % 12, 0])
            sources.add(agent.last_source)
            if "plan" in sources:
                break
            time.sleep(0.02)  # without a pause, more decisions pass during a search than a plan has steps
        assert "plan" in sources
        process = agent.scheduler.executor.process
    assert process is None or not process.is_alive()
