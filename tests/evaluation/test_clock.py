"""The virtual clock and the executor, alone and with every kind of agent."""

import time

import numpy as np
import pytest
import torch

from latentplan.agents.actor import ActorAgent
from latentplan.agents.background import BackgroundAgent
from latentplan.agents.gated import GatedAgent
from latentplan.agents.planning import PlanningAgent
from latentplan.agents.random import RandomAgent
from latentplan.config import Config, EnvConfig, ModelConfig, PlannerConfig
from latentplan.envs import make_env
from latentplan.evaluation.clock import Latency, VirtualClock, VirtualExecutor
from latentplan.evaluation.episodes import run_episodes
from latentplan.evaluation.timed import iterate_timed_episodes, summarize_timed
from latentplan.models import WorldModel

ENV = EnvConfig(domain="cartpole", task="swingup", action_repeat=50, render_quality="fastest")
MODEL = ModelConfig(deter_dim=8, hidden_dim=8, decoder_width=4, encoder_channels=(4, 4), decoder_channels=2, num_bins=5)
PLANNER = PlannerConfig(horizon=4, num_samples=8, num_elites=2, num_policy_samples=1, num_iterations=2)


class Searcher:
    """A planner that returns the number of its calls as the plan."""

    def __init__(self):
        self.count = 0

    def plan(self, model, state, previous=None, *, objective=None, constraints=(), generator=None):
        self.count += 1
        return self.count


def constant(decision_ms, plan_ms):
    return Latency("file", np.array([float(decision_ms)]), np.array([float(plan_ms)]))


def executor_on(clock):
    return VirtualExecutor(Searcher(), None, clock)


STATE = torch.zeros(1, 2)


def test_executor_returns_a_plan_when_its_duration_has_passed():
    clock = VirtualClock(50.0, constant(0, 30))
    executor = executor_on(clock)
    clock.advance(3)  # 60 ms
    assert executor.request(STATE, tick=7)
    assert not executor.is_idle and not executor.request(STATE, tick=8)
    assert executor.requested_ms == {7: 60.0}
    clock.advance(4)
    assert executor.poll() is None  # 20 ms later
    clock.advance(5)
    assert executor.poll() == (7, 1)
    assert executor.is_idle and executor.poll() is None


@pytest.mark.parametrize("control_hz", [30.0, 60.0, 70.0, 90.0, 144.0])
def test_executor_returns_a_plan_of_one_period_at_the_end_of_the_period(control_hz):
    clock = VirtualClock(control_hz, constant(0, 1000.0 / control_hz))
    executor = executor_on(clock)
    for tick in range(1000):
        clock.advance(tick)
        executor.request(STATE, tick=tick)
        clock.advance(tick + 1)
        assert executor.poll() is not None


def test_executor_returns_a_plan_at_once_when_it_takes_no_time():
    for clock in (VirtualClock(50.0, constant(0, 0)), VirtualClock(None, Latency())):
        executor = executor_on(clock)
        executor.request(STATE, tick=0)
        assert executor.poll() == (0, 1)


def test_executor_drops_the_pending_plan_when_an_episode_begins():
    clock = VirtualClock(50.0, constant(0, 1000))
    executor = executor_on(clock)
    executor.request(STATE, tick=0)
    clock.restart(1)
    assert executor.is_idle and executor.requested_ms == {}
    executor.request(STATE, tick=5)
    clock.advance(50)
    assert executor.poll() == (5, 2)


def test_executor_charges_measured_plans_apart_from_the_decision():
    class Slow(Searcher):
        def plan(self, model, state, previous=None, *, objective=None, constraints=(), generator=None):
            time.sleep(0.05)
            return super().plan(model, state, previous, generator=generator)

    clock = VirtualClock(1000.0, Latency())
    executor = VirtualExecutor(Slow(), None, clock)

    class Asker:
        def act(self, frame):
            executor.request(STATE, tick=0)
            return np.zeros(1, np.float32)

    _, decision_ms = clock.decide(Asker(), np.zeros((64, 64, 3), np.uint8))
    assert decision_ms < 50.0
    clock.advance(50)
    assert executor.poll() is None
    clock.advance(10_000)
    assert executor.poll() == (0, 1)


@pytest.fixture(scope="module")
def env():
    env = make_env(ENV)
    yield env
    env.close()


@pytest.fixture(scope="module")
def model():
    torch.manual_seed(0)
    return WorldModel(MODEL, action_dim=1)


@pytest.mark.parametrize("kind", [PlanningAgent, GatedAgent, ActorAgent, RandomAgent])
def test_timed_episodes_equal_plain_episodes_when_decisions_take_no_time(env, model, kind):
    config = Config(env=ENV, model=MODEL, planner=PLANNER)
    makers = {RandomAgent: lambda: RandomAgent(1), ActorAgent: lambda: ActorAgent(model, config)}
    make = makers.get(kind, lambda: kind(model, config, 0.9))
    returns = [[episode.total_return for episode in run_episodes(env, make(), [0])]]
    for clock in (VirtualClock(None, Latency()), VirtualClock(50.0, constant(0, 0))):
        returns.append([episode.total_return for episode in iterate_timed_episodes(env, make(), [0], clock)])
    assert returns[0] == returns[1] == returns[2]


def play_background(env, model, control_hz, latency, episodes=1):
    clock = VirtualClock(control_hz, latency)
    agent = BackgroundAgent(
        model,
        Config(env=ENV, model=MODEL, planner=PLANNER),
        discount=0.9,
        make_executor=lambda planner, model: VirtualExecutor(planner, model, clock),
    )
    return summarize_timed(list(iterate_timed_episodes(env, agent, range(episodes), clock)), clock)


def test_background_agent_acts_as_in_a_waiting_world_when_plans_take_no_time(env, model):
    waiting = play_background(env, model, None, Latency())
    timed = play_background(env, model, 50.0, constant(0, 0))
    assert timed["returns"] == waiting["returns"]
    assert timed["action_source"] == waiting["action_source"] == {"plan": 19, "tail": 0, "actor": 1}
    assert timed["plan_age_ms"]["p50"] == 20.0  # requested one decision before it is due
    assert timed["planned_fraction"] == pytest.approx(0.95)


def test_background_agent_repeats_under_a_given_latency(env, model):
    spread = Latency("file", np.array([0.0, 3.0]), np.array([10.0, 30.0, 70.0]))
    first, again = (play_background(env, model, 50.0, spread, episodes=2) for _ in range(2))
    assert first == again
    assert first["deadline_misses"] == 0
    assert first["returns"][:1] != play_background(env, model, 50.0, constant(0, 0))["returns"]


def test_background_agent_acts_by_the_actor_when_plans_are_slow(env, model):
    result = play_background(env, model, 50.0, constant(0, 1e6))
    assert result["action_source"] == {"plan": 0, "tail": 0, "actor": 20}
    assert result["plan_age_ms"] is None


def test_plan_age_is_at_least_the_duration_of_the_plan(env, model):
    result = play_background(env, model, 50.0, constant(0, 50))
    assert result["deadline_misses"] == 0
    assert result["plan_age_ms"]["p50"] >= 60.0  # ready at the third boundary after its request
    assert result["planned_fraction"] > 0.7


def test_gated_agent_is_charged_and_reports_its_planned_fraction(env, model):
    clock = VirtualClock(50.0, constant(5, 0))
    agent = GatedAgent(model, Config(env=ENV, model=MODEL, planner=PLANNER), 0.9, planning_budget=0.5)
    result = summarize_timed(list(iterate_timed_episodes(env, agent, [0, 1], clock)), clock)
    sources = result["action_source"]
    assert sources["plan"] > 0 and sources["actor"] > 0 and sum(sources.values()) == 40
    assert result["planned_fraction"] == agent.planned_fraction == sources["plan"] / 40
    assert result["plan_age_ms"]["p99"] == 5.0
