"""The action of each tick, and the plans that are requested, counted in ticks without a clock or process."""

import itertools

import pytest
import torch

from latentplan.planning import CEMPlanner, FunctionModel, PlanBuffer, PlanScheduler, learned_return, rate_limit
from latentplan.planning.realtime.scheduler import NominalTrajectory
from tests.planning.realtime.integrator import dynamics, policy, reward

HORIZON = 4


def plan_of(value, horizon=HORIZON):
    """Actions (1, horizon, 1) that tell their plan and index: value.0, value.1, ..."""
    return (value + 0.1 * torch.arange(horizon))[None, :, None]


def chosen(buffer, tick):
    action, source, age = buffer.choose(tick)
    return None if action is None else (round(action.item(), 4), source, age)


def test_buffer_returns_the_action_at_the_plans_age():
    buffer = PlanBuffer(fresh_ticks=1)
    buffer.submit(plan_of(1.0), 10)
    expected = [(1.0, "plan", 0), (1.1, "plan", 1), (1.2, "tail", 2), (1.3, "tail", 3), None]
    assert [chosen(buffer, tick) for tick in range(10, 15)] == expected
    assert buffer.choose(15) == (None, None, None)


def test_buffer_drops_plans_beyond_max_age():
    buffer = PlanBuffer(max_age=2, fresh_ticks=0)
    buffer.submit(plan_of(1.0), 10)
    assert [chosen(buffer, tick) for tick in (10, 12, 13)] == [(1.0, "plan", 0), (1.2, "tail", 2), None]


def test_buffer_skips_the_first_actions_of_a_late_plan():
    buffer = PlanBuffer()
    buffer.submit(plan_of(1.0), 10)
    assert chosen(buffer, 12) == (1.2, "tail", 2)


def test_buffer_uses_the_last_plan_until_the_next_one_is_due():
    buffer = PlanBuffer()
    buffer.submit(plan_of(1.0), 10)
    buffer.submit(plan_of(2.0), 12)
    assert [chosen(buffer, tick)[0] for tick in (10, 11, 12, 13)] == [1.0, 1.1, 2.0, 2.1]
    buffer.submit(plan_of(3.0), 20)
    assert chosen(buffer, 16) is None and chosen(buffer, 20) == (3.0, "plan", 0)


def test_buffer_drops_a_plan_older_than_the_newest():
    buffer = PlanBuffer()
    buffer.submit(plan_of(2.0), 12)
    buffer.submit(plan_of(1.0), 11)
    assert chosen(buffer, 11) is None and chosen(buffer, 12)[0] == 2.0
    buffer.submit(plan_of(3.0), 12)  # another for the same tick is newer
    assert chosen(buffer, 12)[0] == 3.0


def test_buffer_peek_drops_no_plan():
    buffer = PlanBuffer()
    buffer.submit(plan_of(1.0), 10)
    buffer.submit(plan_of(2.0), 12)
    ahead = [buffer.peek(tick) for tick in (9, 11, 13, 16)]
    assert [found and (round(found[0].item(), 4), found[1]) for found in ahead] == [None, (1.1, 1), (2.1, 1), None]
    assert chosen(buffer, 10)[0] == 1.0
    assert buffer.remaining(11).shape == (1, 3, 1) and buffer.remaining(16) is None
    buffer.clear()
    assert chosen(buffer, 12) is None


@pytest.mark.parametrize("name", ["max_age", "fresh_ticks"])
def test_buffer_refuses_negative_ages(name):
    with pytest.raises(ValueError, match=name):
        PlanBuffer(**{name: -1})


class VirtualExecutor:
    """Computes a plan when it is asked for, and gives it when the virtual time has come."""

    def __init__(self, planner, model, durations):
        self.planner, self.model, self.durations = planner, model, iter(durations)
        self.now, self.requests, self.work = 0.0, [], None
        self.plan_for = None

    @property
    def is_idle(self):
        return self.work is None

    def request(self, state, tick, previous=None, seed=None):
        self.requests.append((state, tick, previous, seed))
        generator = None if seed is None else torch.Generator().manual_seed(seed)
        plan = self.planner.plan(self.model, state, previous, objective=self.plan_for, generator=generator)
        self.work = (self.now + next(self.durations), tick, plan)
        return True

    def poll(self):
        if self.work is None or self.work[0] > self.now:
            return None
        (_, tick, plan), self.work = self.work, None
        if isinstance(plan, Exception):
            raise plan
        return tick, plan


@pytest.fixture
def model():
    return FunctionModel(dynamics, reward, policy=policy)


def test_scheduler_takes_the_policy_when_a_search_found_nothing_finite():
    broken = FunctionModel(dynamics, lambda state, action: reward(state, action) * torch.nan, policy=policy)
    scheduler, executor = make(broken, itertools.repeat(0.5))
    with pytest.warns(RuntimeWarning, match="nothing finite"):
        decisions, _ = drive(scheduler, executor, 6)
    assert [(decision.source, decision.action.item()) for decision in decisions] == [("actor", pytest.approx(0.05))] * 6


def broken_beyond_10(state, action):
    return torch.where(state[:, 0] > 10.0, torch.nan, reward(state, action))


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("choices", [None, {0: (-1.0, 0.0, 0.05)}])
def test_policy_acts_in_environments_for_which_a_search_found_nothing(choices):
    model = FunctionModel(dynamics, broken_beyond_10, policy=policy)
    planner = CEMPlanner(action_dim=1, horizon=HORIZON, num_samples=32, num_elites=4, action_choices=choices)
    executor = VirtualExecutor(planner, model, itertools.repeat(0.5))
    decisions, _ = drive(PlanScheduler(planner, model, executor), executor, 4, start=[[9.0], [20.0]])
    assert [decision.source for decision in decisions] == ["actor", "plan", "plan", "plan"]
    for decision in decisions[1:]:
        assert decision.action[0] < 0.0 and decision.action[1] == pytest.approx(0.05)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_plan_goes_on_without_a_policy_where_a_search_found_nothing():
    model = FunctionModel(dynamics, broken_beyond_10)
    scheduler, executor = make(model, itertools.repeat(0.5))
    decisions, _ = drive(scheduler, executor, 3, start=[[2.0], [20.0]])
    plan = executor.planner.plan(model, torch.tensor([[20.0]]))
    assert torch.equal(decisions[-1].action[1], plan.action[0])


@pytest.mark.parametrize("policy", [None, policy])
@pytest.mark.parametrize("constraints", [(), (rate_limit(0.3),)])
def test_changes_of_a_decision_do_not_reach_the_scheduler(policy, constraints):
    made = [make(FunctionModel(dynamics, reward, policy=policy), itertools.repeat(0.5)) for _ in range(2)]
    state = torch.tensor([[2.0]])
    for scheduler, executor in made:
        executor.set_objective = lambda *goals: None
        scheduler.set_objective(None, constraints)
    for _ in range(6):
        first, second = (scheduler.decide(state).action for scheduler, _ in made)
        assert torch.equal(first, second)
        state = dynamics(state, second)
        first.mul_(10.0)
        for _, executor in made:
            executor.now += 1.0


def test_bounds_of_later_steps_prevail_over_a_rate_limit(model):
    high = torch.tensor([[1.0], [1.0], [0.5], [0.2]])
    planner = CEMPlanner(action_dim=1, horizon=HORIZON, num_samples=16, num_elites=4, action_high=high)
    executor = VirtualExecutor(planner, model, itertools.repeat(9.5))
    executor.set_objective = lambda *goals: None
    scheduler = PlanScheduler(planner, model, executor)
    scheduler.set_objective(None, [rate_limit(0.1)])
    scheduler.tick = 1
    scheduler.buffer.submit(torch.ones(1, HORIZON, 1), 1)
    scheduler._nominals[1] = NominalTrajectory(model, torch.tensor([[5.0]]), torch.ones(1, HORIZON, 1))
    scheduler._batch = 1
    decisions = [scheduler.decide(torch.tensor([[5.0]])) for _ in range(HORIZON)]
    assert [decision.age for decision in decisions] == [0, 1, 2, 3]
    assert all(decision.action <= high[decision.age] + 1e-6 for decision in decisions)


def test_scheduler_ignores_plans_without_a_search(model):
    planner = CEMPlanner(action_dim=1, horizon=HORIZON, num_policy_samples=4, deadline_ms=1e-6)
    executor = VirtualExecutor(planner, model, itertools.repeat(0.5))
    decisions, _ = drive(PlanScheduler(planner, model, executor), executor, 6)
    assert len(executor.requests) == 6 and [decision.source for decision in decisions] == ["actor"] * 6


def make(model, durations, **options):
    planner = CEMPlanner(
        action_dim=1, horizon=HORIZON, num_samples=32, num_elites=4, num_iterations=3, warm_start_iterations=1
    )
    executor = VirtualExecutor(planner, model, durations)
    return PlanScheduler(planner, model, executor, generator=torch.Generator().manual_seed(0), **options), executor


def drive(scheduler, executor, ticks, start=2.0):
    """Decisions one unit of virtual time apart, in a world that is as modelled; and where each was made."""
    state, decisions, states = torch.as_tensor(start).reshape(-1, 1), [], []
    for _ in range(ticks):
        states.append(state)
        decisions.append(scheduler.decide(state))
        state = dynamics(state, decisions[-1].action)
        executor.now += 1.0
    return decisions, states


def test_requests_start_from_the_state_of_their_tick(model):
    """If the model is exact, a plan starts from the state that its tick finds."""
    scheduler, executor = make(model, [2.5] * 100)
    _, states = drive(scheduler, executor, 30)
    asked = [(state, tick) for state, tick, _, _ in executor.requests if 6 < tick < 30]
    assert len(asked) >= 7
    for state, tick in asked:
        torch.testing.assert_close(state, states[tick])


def test_latency_is_counted_in_ticks_without_the_first(model):
    scheduler, executor = make(model, [3.5, *[1.5] * 100])
    drive(scheduler, executor, 5)
    assert scheduler.latency_ticks == 1
    decisions, _ = drive(scheduler, executor, 25)
    assert scheduler.latency_ticks == scheduler.buffer.fresh_ticks == 2
    assert {(decision.source, decision.age) for decision in decisions[-10:]} == {("plan", 0), ("plan", 1)}


def test_latency_ticks_are_at_most_the_horizon(model):
    scheduler, executor = make(model, [1.0, *[50.0] * 10])
    drive(scheduler, executor, 200)
    assert scheduler.latency_ticks == HORIZON


def test_scheduler_has_a_plan_at_every_tick_when_latency_jitters(model):
    scheduler, executor = make(model, [(0.4, 1.6, 1.2, 0.9, 2.3)[index % 5] for index in range(100)])
    decisions, _ = drive(scheduler, executor, 60)
    assert all(decision.source in ("plan", "tail") for decision in decisions[8:])
    assert all(decision.action.abs() <= 1.0 for decision in decisions)


def test_scheduler_takes_tail_then_actor_when_no_plan_arrives(model):
    scheduler, executor = make(model, [0.5] * 5 + [1e9])
    decisions, _ = drive(scheduler, executor, 16)
    sources = [decision.source for decision in decisions]
    assert sources[0] == "actor" and sources[1:6] == ["plan"] * 5
    assert sources[6:9] == ["plan", "tail", "tail"]  # ages 1 to 3 of the last plan that came
    assert sources[9:] == ["actor"] * 7
    assert all(decision.action == 0.05 and decision.age is None for decision in decisions[9:])


def test_requests_carry_the_last_plan_shifted_to_their_tick(model):
    scheduler, executor = make(model, [1.5] * 100)
    drive(scheduler, executor, 20)
    assert executor.requests[0][2] is None
    for (_, before, _, _), (_, tick, previous, _) in zip(executor.requests[3:], executor.requests[4:], strict=False):
        assert previous.elapsed.tolist() == [tick - before]
    late, executor = make(model, [8.0] * 100)
    drive(late, executor, 40)
    assert all(previous is None for _, _, previous, _ in executor.requests)  # nothing of the last plan is left


def test_requests_have_rising_ticks_and_distinct_seeds(model):
    scheduler, executor = make(model, [(0.2, 2.5)[index % 2] for index in range(100)])
    drive(scheduler, executor, 60)
    ticks, seeds = [request[1] for request in executor.requests], [request[3] for request in executor.requests]
    assert all(left < right for left, right in zip(ticks, ticks[1:], strict=False))
    assert len(set(seeds)) == len(seeds)


def test_scheduler_reset_drops_the_plan_of_the_running_request(model):
    scheduler, executor = make(model, [2.5] * 100)
    drive(scheduler, executor, 10)
    assert not executor.is_idle
    due = executor.requests[-1][1]
    scheduler.reset()
    decisions, _ = drive(scheduler, executor, 4)
    assert [decision.source for decision in decisions[:3]] == ["actor"] * 3
    after = [request for request in executor.requests if request[1] > due]
    assert after[0][2] is None  # the next search starts cold
    decisions, _ = drive(scheduler, executor, 10)
    assert decisions[-1].source == "plan"


def test_scheduler_takes_the_middle_of_the_bounds_without_a_policy():
    planner = CEMPlanner(action_dim=1, horizon=HORIZON, action_low=0.2)
    model = FunctionModel(dynamics, reward)
    scheduler = PlanScheduler(planner, model, VirtualExecutor(planner, model, [1e9]))
    assert scheduler.decide(torch.zeros(2, 1)).action.tolist() == [[pytest.approx(0.6)]] * 2


def test_scheduler_raises_a_search_error_once(model):
    scheduler, executor = make(model, [0.5] * 100)
    drive(scheduler, executor, 4)
    scheduler.executor.work = (executor.now, 4, KeyError("broken"))
    with pytest.raises(KeyError, match="broken"):
        scheduler.decide(torch.zeros(1, 1))
    decisions, _ = drive(scheduler, executor, 5)
    assert decisions[-1].source == "plan"


def test_scheduler_repeats_its_decisions_with_equal_seeds_and_durations(model):
    runs = []
    for _ in range(2):
        scheduler, executor = make(model, [1.3] * 100)
        runs.append(torch.cat([decision.action for decision in drive(scheduler, executor, 20)[0]]))
    assert torch.equal(*runs)


def noisy_dynamics(state, action, generator=None):
    return dynamics(state, action) + 0.1 * torch.randn(state.shape, generator=generator)


def test_scheduler_repeats_its_decisions_in_a_model_that_samples(model):
    noisy, runs = FunctionModel(noisy_dynamics, reward, policy=model.policy), []
    before = torch.get_rng_state()
    for _ in range(2):
        scheduler, executor = make(noisy, [1.3] * 100)
        runs.append(torch.cat([decision.action for decision in drive(scheduler, executor, 20)[0]]))
    assert torch.equal(*runs)
    assert torch.equal(torch.get_rng_state(), before)


def test_scheduler_uses_longer_plans_for_objectives_to_their_end(model):
    """Plans for an objective may be longer than plans for the predicted return."""
    planner = CEMPlanner(action_dim=1, horizon=2, goal_horizon=6, num_samples=32, num_elites=4)
    executor = VirtualExecutor(planner, model, [0.5, 1e9])
    executor.plan_for = learned_return()
    scheduler = PlanScheduler(planner, model, executor)
    decisions, _ = drive(scheduler, executor, 9)
    assert [decision.source for decision in decisions] == ["actor", "plan", "plan", *["tail"] * 4, "actor", "actor"]


def test_scheduler_drops_plans_when_the_number_of_environments_changes(model):
    scheduler, executor = make(model, itertools.repeat(0.5))
    drive(scheduler, executor, 6)
    assert scheduler.decide(torch.ones(3, 1)).action.shape == (3, 1)
