"""Deadlines: no iteration starts that cannot end in time, and a search always returns a plan."""

import dataclasses
import math
import pickle
import time

import pytest
import torch

from latentplan.config import PlannerConfig
from latentplan.planning import CEMPlanner, FunctionModel, ModelPredictiveController
from latentplan.planning.search.deadline import Pace

HORIZON = 4


class Clock:
    """A clock that tests advance."""

    def __init__(self):
        self.seconds = 100.0

    def __call__(self):
        return self.seconds


class TimedModel:
    """A pull to the origin; each fused rollout (one per iteration) takes `rollout_ms` of the clock's time."""

    def __init__(self, clock, rollout_ms=10.0):
        self.clock, self.rollout_ms, self.num_rollouts = clock, rollout_ms, 0

    def step(self, state, action):
        following = state + 0.3 * action
        return following, -following.square().sum(dim=1)

    def rollout(self, state, actions):
        self.num_rollouts += 1
        self.clock.seconds += self.rollout_ms / 1000
        rewards = []
        for action in actions.unbind(1):
            state, reward = self.step(state, action)
            rewards.append(reward)
        return torch.stack(rewards, dim=1), state


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def model(clock):
    return TimedModel(clock)


@pytest.fixture
def state():
    return torch.tensor([[1.0, -1.0], [0.5, 2.0]])


@pytest.fixture
def make(clock):
    def make(**options):
        defaults = {"num_samples": 32, "num_elites": 4, "num_iterations": 6, "num_policy_samples": 0, "clock": clock}
        defaults |= {"final": "mean", "noise_beta": 0.0, "keep_elite_fraction": 0.0}  # no rollout but the iterations'
        return CEMPlanner(action_dim=2, horizon=HORIZON, **defaults | options)

    return make


@pytest.fixture
def warm(make, model, state, seeded):
    """A planner that has measured its iterations of 10 ms, and its last plan."""
    planner = make()
    return planner, planner.plan(model, state, generator=seeded())


def spent_ms(clock, call):
    started = clock()
    result = call()
    return 1000 * (clock() - started), result


@pytest.mark.parametrize(("deadline_ms", "iterations"), [(10, 1), (19, 1), (20, 2), (35, 3), (59, 5)])
def test_deadline_allows_as_many_iterations_as_fit(warm, model, state, clock, deadline_ms, iterations):
    planner, _ = warm
    spent, plan = spent_ms(clock, lambda: planner.plan(model, state, deadline_ms=deadline_ms))
    assert plan.info["stopped"] == "deadline"
    assert plan.info["iterations"].tolist() == [iterations] * 2
    assert plan.info["elite_return"].shape == plan.info["std"].shape == (2, iterations)
    assert spent <= deadline_ms + 1e-6


def test_info_stopped_is_the_reason_the_search_ended(warm, make, model, state):
    planner, _ = warm
    assert planner.plan(model, state).info["stopped"] == "iterations"
    assert planner.plan(model, state, deadline_ms=60).info["stopped"] == "iterations"
    assert planner.plan(model, state, deadline_ms=59).info["stopped"] == "deadline"


def test_shifted_plan_is_returned_when_no_iteration_fits(warm, model, state, clock):
    planner, last = warm
    before = model.num_rollouts
    plan = planner.plan(model, state, last, deadline_ms=9)
    assert model.num_rollouts == before
    torch.testing.assert_close(plan.actions[:, :-1], last.actions[:, 1:])
    assert (plan.actions[:, -1] == 0).all()
    assert plan.info["is_fallback"].all() and plan.expected_return.isnan().all()
    assert plan.info["stopped"] == "deadline" and plan.is_warm.all()


def test_cold_start_is_returned_and_stays_cold_without_time_and_plan(make, model, state):
    planner = make(action_low=0.25)
    plan = planner.plan(model, state, deadline_ms=0)
    assert (plan.actions == 0.625).all() and plan.actions.shape == (2, HORIZON, 2)  # the middle of [0.25, 1]
    assert not plan.is_warm.any()
    assert planner.plan(model, state, plan).info["iterations"].tolist() == [6, 6]
    assert model.num_rollouts == 6


def test_fallback_plan_has_every_diagnostic(warm, model, state):
    planner, _ = warm
    constraints = [lambda rollout: rollout.actions[:, 0, 0]]
    full = planner.plan(model, state, constraints=constraints)
    none = planner.plan(model, state, constraints=constraints, deadline_ms=0)
    assert none.info.keys() == full.info.keys()
    assert none.info["elite_return"].shape == (2, 0) and none.info["violation"].isnan().all()


@pytest.mark.parametrize("options", [{"gradient_steps": 2}, {"action_choices": 3}])
def test_fallback_plan_has_the_diagnostics_of_its_options(make, model, state, options):
    planner = make(**options)
    full = planner.plan(model, state)
    none = planner.plan(model, state, full, deadline_ms=0)
    assert none.info.keys() == full.info.keys()
    if "gradient_steps" in options:
        assert torch.equal(none.info["gradient_wait"], full.info["gradient_wait"])


def test_fallback_plan_keeps_warm_and_cold_environments_apart(warm, model, state):
    planner, last = warm
    plan = planner.plan(model, state, last.forget(torch.tensor([True, False])), deadline_ms=1)
    assert plan.is_warm.tolist() == [False, True]
    assert (plan.actions[0] == 0).all() and (plan.actions[1] != 0).any()


def test_pace_ignores_the_first_iteration(make, model, state, clock):
    planner = make()
    model.rollout_ms = 500.0  # lazy initialisation
    assert planner.plan(model, state, deadline_ms=50).info["iterations"].tolist() == [1, 1]
    model.rollout_ms = 10.0
    assert planner.plan(model, state, deadline_ms=50).info["iterations"].tolist() == [5, 5]


def test_pace_keeps_durations_by_problem_size(warm, model, state, clock):
    planner, _ = warm
    model.rollout_ms = 100.0
    planner.plan(model, state.repeat(50, 1))
    model.rollout_ms = 10.0
    assert planner.plan(model, state, deadline_ms=30).info["iterations"].tolist() == [3, 3]
    assert planner.plan(model, state.repeat(50, 1), deadline_ms=90).info["iterations"].sum() == 0


def test_pace_adapts_when_the_model_becomes_slower(warm, model, state, clock):
    planner, _ = warm
    model.rollout_ms = 20.0
    planner.plan(model, state)
    spent, plan = spent_ms(clock, lambda: planner.plan(model, state, deadline_ms=50))
    assert plan.info["iterations"].tolist() == [2, 2] and spent <= 50


def test_pace_separates_wrappers_of_different_models(make, model, state, clock):
    class Wrapper(FunctionModel):
        def __init__(self, model):
            self.model, self.step, self.rollout = model, model.step, model.rollout

    planner, slower = make(), type("Slower", (TimedModel,), {})
    planner.plan(Wrapper(slower(clock, 50.0)), state)
    assert planner.plan(Wrapper(model), state, deadline_ms=35).info["iterations"].sum() > 0


def test_pace_refuses_every_iteration_when_none_ever_fitted(warm, model, state):
    planner, _ = warm
    before = model.num_rollouts
    for _ in range(100):
        planner.plan(model, state, deadline_ms=9)
    assert model.num_rollouts == before


def test_pace_tries_again_after_a_single_slow_iteration(make, model, state):
    planner = make(num_iterations=1)
    for rollout_ms in (10.0, 10.0, 900.0):
        model.rollout_ms = rollout_ms
        planner.plan(model, state)
    model.rollout_ms = 10.0
    iterations = [int(planner.plan(model, state, deadline_ms=15).info["iterations"][0]) for _ in range(400)]
    assert iterations[0] == 0 and 1 in iterations[:12]
    assert all(iterations[-50:])


def test_pace_tries_again_when_every_known_duration_of_a_part_was_slow(make, model, state):
    planner = make(num_iterations=4, final="better")  # which part ends a search is recorded once for each search
    for rollout_ms in (1.0, 100.0):
        model.rollout_ms = rollout_ms
        planner.plan(model, state, deadline_ms=20)
    model.rollout_ms = 1.0
    iterations = [int(planner.plan(model, state, deadline_ms=20).info["iterations"][0]) for _ in range(300)]
    assert iterations[0] == 0 and all(iterations[-50:])


def test_pace_keeps_durations_by_objective(make, model, state, clock):
    def slow_goal(rollout):
        clock.seconds += 0.04
        return rollout.rewards.sum(dim=1)

    planner = make()
    for objective in (None, None, slow_goal, slow_goal):
        planner.plan(model, state, objective=objective)
    assert planner.plan(model, state, deadline_ms=60).info["iterations"].tolist() == [6, 6]
    spent, plan = spent_ms(clock, lambda: planner.plan(model, state, objective=slow_goal, deadline_ms=100))
    assert spent <= 100 and plan.info["iterations"].tolist() == [2, 2]


def test_deadline_counts_from_the_call(warm, make, model, state, clock):
    def policy(state, generator):
        clock.seconds += 0.004
        return torch.zeros(len(state), 2)

    model.policy = policy  # the shifted plan's tail is filled by it, before the first iteration
    planner = make(tail="policy")
    last = planner.plan(model, state)
    spent, plan = spent_ms(clock, lambda: planner.plan(model, state, last, deadline_ms=23))
    assert plan.info["iterations"].tolist() == [1, 1] and spent <= 23


def test_deadline_counts_proposals_with_the_first_iteration(make, model, state, clock):
    def policy(state, generator):
        clock.seconds += 0.002
        return torch.zeros(len(state), 2)

    model.policy = policy
    planner = make(num_policy_samples=1)  # 4 steps of its mode take 8 ms
    for _ in range(2):
        planner.plan(model, state)
    assert planner.plan(model, state, deadline_ms=17).info["iterations"].tolist() == [0, 0]
    spent, plan = spent_ms(clock, lambda: planner.plan(model, state, deadline_ms=18.5))
    assert plan.info["iterations"].tolist() == [1, 1] and spent <= 18.5


def test_gradient_steps_are_skipped_when_they_do_not_fit_the_deadline(make, model, state, clock):
    planner = make(gradient_steps=2, num_iterations=2)  # 2 iterations of 10 ms, then 3 rollouts of 10 ms
    for _ in range(2):
        planner.plan(model, state)
    spent, plan = spent_ms(clock, lambda: planner.plan(model, state, deadline_ms=49))
    assert spent == pytest.approx(20) and plan.info["stopped"] == "deadline"
    spent, plan = spent_ms(clock, lambda: planner.plan(model, state, deadline_ms=50))
    assert spent == pytest.approx(50) and plan.info["stopped"] == "iterations"


def test_deadline_of_the_call_replaces_that_of_the_planner(make, model, state):
    planner = make(deadline_ms=20.0)
    for _ in range(2):
        planner.plan(model, state, deadline_ms=math.inf)
    assert planner.plan(model, state).info["iterations"].tolist() == [2, 2]
    assert planner.plan(model, state, deadline_ms=40).info["iterations"].tolist() == [4, 4]
    assert planner.plan(model, state, deadline_ms=math.inf).info["iterations"].tolist() == [6, 6]


def test_plan_is_the_same_when_the_deadline_is_generous(make, model, state, seeded):
    free, bound = make(), make(deadline_ms=1e6)
    for seed in range(3):
        left, right = (planner.plan(model, state, generator=seeded(seed)) for planner in (free, bound))
        assert torch.equal(left.actions, right.actions) and torch.equal(left.var, right.var)


def test_search_cut_by_a_deadline_equals_one_with_fewer_iterations(warm, make, model, state, seeded):
    planner, _ = warm
    short = planner.plan(model, state, generator=seeded(5), deadline_ms=25)
    full = make(num_iterations=2).plan(model, state, generator=seeded(5))
    assert torch.equal(short.actions, full.actions)


def test_pace_of_a_copied_planner_is_empty(warm, model, state):
    planner, _ = warm
    fresh = dataclasses.replace(planner, num_iterations=7)
    assert planner.plan(model, state, deadline_ms=5).info["iterations"].sum() == 0
    assert fresh.plan(model, state, deadline_ms=5).info["iterations"].sum() == 2  # the copy has no durations yet
    pace = Pace()
    for _ in range(2):
        pace.record("iteration", 3.0)
    assert pace.expected("iteration") == 3.0 and pickle.loads(pickle.dumps(pace)).expected("iteration") == 0.0


def test_controller_acts_within_bounds_when_the_deadline_is_too_short(make, model, state, seeded):
    controller = ModelPredictiveController(make(deadline_ms=15.0), model, generator=seeded(), replan_every=2)
    for rollout_ms in (10.0, 10.0, 40.0, 40.0, 10.0, 10.0):
        model.rollout_ms = rollout_ms
        action = controller.act(state)
        assert torch.isfinite(action).all() and (action.abs() <= 1.0).all()
    assert controller.latency.keys() == {"mean_ms", "p50_ms", "p95_ms", "p99_ms"}


@pytest.mark.parametrize("deadline_ms", [-1.0, math.nan])
def test_deadline_is_refused_when_negative_or_nan(make, model, state, deadline_ms):
    with pytest.raises(ValueError, match="deadline_ms must be"):
        make().plan(model, state, deadline_ms=deadline_ms)
    for kind in (make, PlannerConfig):
        with pytest.raises(ValueError, match="deadline_ms must be above 0"):
            kind(deadline_ms=deadline_ms)


def test_slow_model_keeps_a_deadline_in_real_time(state):
    def dynamics(state, action):
        time.sleep(0.02)
        return state + 0.3 * action

    model = FunctionModel(dynamics, lambda state, action: -state.square().sum(dim=1))
    planner = CEMPlanner(action_dim=2, horizon=HORIZON, num_samples=16, num_elites=4, num_iterations=12)
    planner.plan(model, state)  # an iteration sleeps 80 ms, all of them 960 ms
    started = time.perf_counter()
    plan = planner.plan(model, state, deadline_ms=400)
    spent_ms = 1000 * (time.perf_counter() - started)
    assert plan.info["stopped"] == "deadline"
    assert 1 <= int(plan.info["iterations"][0]) <= 5
    assert spent_ms < 800  # what a busy machine adds stays below what all iterations sleep
