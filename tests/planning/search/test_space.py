"""Bounds per step and environment, starts, splines and rate limits: what candidates, models and plans see."""

import pytest
import torch

from latentplan.planning import (
    FunctionModel,
    ModelPredictiveController,
    Plan,
    PlanScheduler,
    Rollout,
    action_penalty,
    learned_return,
    rate_limit,
    smoothness_penalty,
)
from latentplan.planning.plan import shift_plan
from latentplan.planning.search.choices import Choices
from latentplan.planning.search.space import Bounds, Space


@pytest.fixture
def recorder():
    """A model that wants the highest actions, and the candidates that it was given, (rows, horizon, action)."""

    class Recorder:
        seen = []

        def step(self, state, action):
            raise AssertionError("a rollout is enough")

        def rollout(self, state, actions):
            self.seen.append(actions.detach().clone())
            return actions.sum(dim=2), state

    Recorder.seen = []
    return Recorder()


def constant(*rewards):
    """A model whose state never changes."""
    return FunctionModel(lambda state, action: state, *rewards)


def test_cold_start_is_the_middle_of_one_sided_bounds(recorder, make_planner, seeded):
    planner = make_planner(action_low=(0.0, -3.0), action_high=(1.0, -1.0), init_std=None, num_iterations=1)
    planner.plan(recorder, torch.zeros(2, 1), generator=seeded())
    middle = torch.tensor([0.5, -2.0])
    torch.testing.assert_close(recorder.seen[0][0], middle.expand(6, 2))
    torch.testing.assert_close(recorder.seen[0].mean(dim=(0, 1)), middle, atol=0.1, rtol=0)


@pytest.mark.parametrize(
    "given",
    [0.25, [0.25, 0.25], [[0.25, 0.25]] * 6, torch.full((2, 6, 2), 0.25), Plan.around(torch.full((1, 4, 2), 0.25))],
    ids=["number", "dimensions", "sequence", "environments", "plan"],
)
def test_init_mean_is_the_start_of_a_cold_search_and_the_zero_tail(recorder, make_planner, seeded, given):
    planner = make_planner(init_mean=given, init_std=0.0, num_iterations=1)
    cold = planner.plan(recorder, torch.zeros(2, 1), generator=seeded())
    assert (cold.mean == 0.25).all()
    warm = planner.plan(recorder, torch.zeros(2, 1), Plan.around(torch.full((2, 3, 2), 0.5)), generator=seeded())
    assert (warm.mean[:, :3] == 0.5).all() and (warm.mean[:, 3:] == 0.25).all()


def test_init_mean_is_clamped_and_checked(recorder, make_planner):
    assert (make_planner(init_mean=7.0, init_std=0.0).plan(recorder, torch.zeros(1, 1)).mean == 1.0).all()
    for bad in ([0.0, 0.0, 0.0], float("nan"), Plan.around(torch.zeros(4, 3))):
        with pytest.raises(ValueError, match="init_mean"):
            make_planner(init_mean=bad)
    with pytest.raises(ValueError, match="init_mean is for 3 environments"):
        make_planner(init_mean=torch.zeros(3, 6, 2)).plan(recorder, torch.zeros(2, 1))


def test_bounds_per_step_hold_in_model_and_plan(recorder, make_planner, seeded):
    low = torch.linspace(-1.0, 0.0, 6)[:, None].expand(6, 2)
    high = low + torch.linspace(0.5, 0.1, 6)[:, None]
    for planner, given in (
        (make_planner(action_low=low, action_high=high), {}),
        (make_planner(), {"bounds": (low, high)}),
    ):
        plan = planner.plan(recorder, torch.zeros(3, 1), generator=seeded(), **given)
        for actions in (*recorder.seen, plan.actions, plan.mean):
            assert (actions >= low - 1e-6).all() and (actions <= high + 1e-6).all()
        recorder.seen.clear()


def test_bounds_per_environment_give_each_the_plan_it_has_alone(point, states, make_planner, seeded):
    low = torch.linspace(-1.0, 0.2, 5)[:, None, None].expand(5, 1, 2)
    high = torch.full((5, 1, 2), 0.6)
    together = make_planner(action_low=low, action_high=high).plan(
        point, states, generator=[seeded(i) for i in range(5)]
    )
    for row in range(5):
        planner = make_planner(action_low=low[row, 0], action_high=0.6)
        alone = planner.plan(point, states[row : row + 1], generator=seeded(row))
        torch.testing.assert_close(together.actions[row], alone.actions[0], atol=1e-4, rtol=0)


@pytest.mark.parametrize("bounds", [("low",), ("high",), ("low", "high")])
def test_bounds_per_environment_hold_for_a_policy_too(point, states, make_planner, seeded, bounds):
    given = {"low": torch.linspace(-1.0, -0.2, 5)[:, None, None], "high": torch.linspace(0.1, 1.0, 5)[:, None, None]}
    options = {f"action_{name}": given[name].expand(5, 1, 2) for name in bounds}
    planner = make_planner(num_policy_samples=4, tail="policy", **options)
    plan = planner.plan(point, states, generator=seeded())
    plan = planner.plan(point, states, plan, generator=seeded())
    low, high = (options.get(f"action_{name}", torch.tensor(limit)) for name, limit in (("low", -1.0), ("high", 1.0)))
    assert (plan.actions >= low - 1e-6).all() and (plan.actions <= high + 1e-6).all()


def test_bounds_are_refused_when_they_do_not_fit(recorder, make_planner):
    with pytest.raises(ValueError, match="low is for 2 environments and 1 steps, the plan for 3 and 6"):
        make_planner(action_low=torch.full((2, 1, 2), -1.0)).plan(recorder, torch.zeros(3, 1))
    with pytest.raises(ValueError, match="low is for 1 environments and 4 steps"):
        make_planner(action_low=torch.full((4, 2), -1.0)).plan(recorder, torch.zeros(3, 1))
    with pytest.raises(ValueError, match="action_low .* must lie below action_high"):
        make_planner().plan(recorder, torch.zeros(1, 1), bounds=(0.5, 0.5))
    with pytest.raises(ValueError, match="action_high must end in 2 numbers"):
        make_planner(action_high=torch.ones(6, 3))


def test_policy_proposals_and_tail_keep_bounds_per_step(point, states, make_planner, seeded):
    high = torch.linspace(0.05, 0.5, 6)[:, None].expand(6, 2)
    planner = make_planner(action_low=-high, action_high=high, num_policy_samples=8, tail="policy", final="better")
    plan = planner.plan(point, states, generator=seeded())
    plan = planner.plan(point, states, plan, generator=seeded())
    assert (plan.actions.abs() <= high + 1e-6).all()


@pytest.mark.parametrize("spline", ["zero", "linear", "cubic"])
def test_spline_decodes_what_it_encodes_and_holds_a_constant(spline):
    bounds = Bounds(torch.full((1, 1, 2), -3.0), torch.full((1, 1, 2), 3.0))
    space = Space(bounds, 10, spline=spline, num_knots=4)
    knots = 2 * torch.rand(3, 5, 4, 2, generator=torch.Generator().manual_seed(0)) - 1
    actions = space.decode(knots)
    assert actions.shape == (3, 5, 10, 2)
    if spline != "cubic":  # a cubic spline may leave the bounds between knots and is clamped there
        torch.testing.assert_close(space.encode(actions), knots, atol=1e-4, rtol=0)
    constant = torch.full((1, 10, 2), 0.7)
    torch.testing.assert_close(space.decode(space.encode(constant)), constant, atol=1e-5, rtol=0)


@pytest.mark.parametrize(("horizon", "num_knots"), [(5, 4), (7, 5), (10, 7), (15, 11), (6, 6), (12, 3)])
def test_spline_of_choices_decodes_what_it_encodes(horizon, num_knots):
    choices = Choices({0: (0.0, 1.0, 2.0)}, torch.float32, torch.device("cpu"))
    bounds = Bounds(torch.zeros(1, 1, 1), torch.full((1, 1, 1), 2.0), choices)
    space = Space(bounds, horizon, spline="linear", num_knots=num_knots)
    knots = torch.randint(3, (4, 6, num_knots, 1), generator=torch.Generator().manual_seed(0)).float()
    torch.testing.assert_close(space.encode(space.decode(knots)), knots)


def test_plan_on_another_device_is_moved_to_the_search():
    rest = torch.empty(1, 4, 2, device="meta")
    same = {"fit": lambda given: given, "policy_tail": lambda given, _: given}
    shifted = shift_plan(Plan.around(torch.zeros(4, 2)), rest=rest, tail="hold", **same)
    assert shifted.mean.device.type == "meta" and shifted.mean.shape == (1, 4, 2)


def test_rate_limits_for_different_numbers_of_dimensions_are_refused():
    with pytest.raises(ValueError, match=r"different numbers of dimensions: \[2, 3\]"):
        rate_limit([0.1, 0.2], per_second=[1.0, 2.0, 3.0], step_seconds=0.1)
    assert rate_limit([0.1, 0.2], per_second=[1.5], step_seconds=0.1).max_change == pytest.approx((0.1, 0.15))


def test_rate_limit_of_another_number_of_dimensions_is_refused(recorder, make_planner):
    with pytest.raises(ValueError, match="rate_limit is for 3 dimensions, an action has 2"):
        make_planner().plan(recorder, torch.zeros(3, 1), constraints=[rate_limit([0.1, 0.2, 0.3])])


def test_linear_spline_bends_at_its_knots_only_and_zero_spline_jumps_there(recorder, make_planner, seeded):
    make_planner(action_spline="linear", num_knots=3, horizon=9).plan(recorder, torch.zeros(1, 1), generator=seeded())
    bends = recorder.seen[0].diff(n=2, dim=1).abs().amax(dim=(0, 2))
    assert (bends[[0, 1, 2, 4, 5, 6]] < 1e-5).all() and bends[3] > 0.1
    recorder.seen.clear()
    make_planner(action_spline="zero", num_knots=3, horizon=9).plan(recorder, torch.zeros(1, 1), generator=seeded())
    jumps = recorder.seen[0].diff(dim=1).abs().amax(dim=(0, 2))
    assert (jumps[[0, 1, 3, 4, 6, 7]] == 0).all() and (jumps[[2, 5]] > 0.1).all()


@pytest.mark.parametrize("spline", ["zero", "linear", "cubic"])
def test_search_over_knots_finds_smooth_plans_with_fewer_candidates(make_planner, seeded, spline):
    """A heavy mass must be pushed steadily; plans have the length and the bounds of actions."""

    def dynamics(state, action):
        return torch.cat([state[:, :1] + 0.05 * state[:, 1:], state[:, 1:] + 0.05 * action[:, :1]], dim=1)

    model = FunctionModel(dynamics, lambda state, action: state[:, 0])
    sizes = {"action_dim": 1, "horizon": 24, "num_samples": 24, "num_iterations": 2, "final": "better"}
    knots, plain = (
        make_planner(**sizes, **options).plan(model, torch.zeros(8, 2), generator=[seeded(i) for i in range(8)])
        for options in ({"action_spline": spline, "num_knots": 4}, {})
    )
    assert knots.actions.shape == (8, 24, 1) and knots.actions.abs().max() <= 1.0
    assert knots.expected_return.mean() > plain.expected_return.mean() + 0.5


def test_splines_are_inverted_once_for_all_decisions(recorder, make_planner, seeded, monkeypatch):
    calls, invert = [], torch.linalg.pinv
    monkeypatch.setattr(torch.linalg, "pinv", lambda matrix: (calls.append(matrix), invert(matrix))[1])
    planner = make_planner(action_spline="cubic", horizon=11, num_knots=4)
    for _ in range(3):
        planner.plan(recorder, torch.zeros(1, 1), generator=seeded())
    planner.plan(recorder, torch.zeros(1, 1).double(), generator=seeded())
    assert len(calls) == 2  # one for each precision


def test_search_over_knots_starts_warm_and_keeps_elites(make_planner, seeded):
    model = FunctionModel(lambda state, action: state + action, lambda state, action: -state.square().sum(dim=1))
    options = {"action_spline": "linear", "num_knots": 3, "keep_elite_fraction": 0.5, "final": "better"}
    controller = ModelPredictiveController(make_planner(**options), model, generator=seeded())
    state = torch.tensor([[2.0, -1.5]])
    for _ in range(8):
        state = state + controller.act(state)
    assert state.abs().max() < 0.3 and controller.plan.elites.shape[2] == 6


OVERSHOOTING = [
    {"overshoot": 1.0},
    {"overshoot": 1.0, "final": "best", "keep_elite_fraction": 1.0},
    {"overshoot": 1.0, "tail": "policy", "num_policy_samples": 2},
    {"overshoot": 1.0, "action_spline": "cubic", "num_knots": 3},
    {"overshoot": 1.0, "action_choices": {1: (-1.0, 0.0, 1.0)}},
    {"overshoot": 1.0, "gradient_steps": 2},
]


@pytest.mark.parametrize("options", OVERSHOOTING)
def test_overshooting_search_imagines_and_executes_actions_within_the_bounds(make_planner, seeded, options):
    seen = []

    def reward(state, action):
        seen.append(action.detach())
        return action[:, 0] - (action[:, 1] - 0.5).square()

    model = FunctionModel(lambda state, action: state + action, reward)
    model.policy = lambda state, generator: torch.full((len(state), 2), 9.0)
    controller = ModelPredictiveController(make_planner(**options), model, generator=seeded())
    for _ in range(3):
        action = controller.act(torch.zeros(2, 2))
        plan = controller.plan
        for within in (action, plan.actions, plan.mean, *seen):
            assert within.abs().max() <= 1.0


def test_overshooting_mean_reaches_the_bound_where_the_best_actions_lie(recorder, make_planner, seeded):
    plans = [
        make_planner(overshoot=overshoot, num_samples=128, num_iterations=6).plan(
            recorder, torch.zeros(1, 2), generator=seeded()
        )
        for overshoot in (0.0, 1.0)
    ]
    inside, outside = (plan.mean for plan in plans)  # a mean of actions below the bound lies below it
    assert inside.max() < 1.0 and (outside == 1.0).all()


def test_overshooting_keeps_elites_outside_of_the_bounds_for_the_next_search(recorder, make_planner, seeded):
    planner = make_planner(overshoot=0.5, init_std=1.0, num_samples=64, keep_elite_fraction=1.0)
    first = planner.plan(recorder, torch.zeros(1, 2), generator=seeded())
    assert 1.0 < first.elites.max() <= 2.0 and first.elites.min() >= -2.0
    inside = make_planner(num_samples=64, keep_elite_fraction=1.0).plan(recorder, torch.zeros(1, 2), first)
    assert inside.elites.abs().max() <= 1.0
    assert torch.cat(recorder.seen).abs().max() <= 1.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_knots": 3}, "num_knots .* needs action_spline"),
        ({"action_spline": "linear", "num_knots": 9}, "num_knots .9. must not exceed the horizon .6."),
        ({"action_spline": "quintic"}, "action_spline must be one of null, zero, linear, cubic"),
        ({"action_spline": "zero", "num_knots": 0}, "num_knots must be a whole number"),
    ],
)
def test_spline_options_are_checked(make_planner, options, message):
    with pytest.raises(ValueError, match=message):
        make_planner(**options)


def greedy():
    """A model that pays for large actions of alternating sign, so that only a limit keeps changes small."""
    return FunctionModel(
        lambda state, action: -state, lambda state, action: (state[:, :1] * action).sum(dim=1) - 0 * state[:, 0]
    )


@pytest.mark.parametrize(
    "limit",
    [
        rate_limit(0.3),
        rate_limit(per_second=3.0, step_seconds=0.1),
        rate_limit((0.3, 0.3)),
        rate_limit(0.3, per_second=9.0, step_seconds=0.1),
    ],
)
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"final": "better"},
        {"gradient_steps": 3},
        {"action_spline": "linear"},
        {"overshoot": 2.0, "num_samples": 64},
    ],
)
def test_rate_limit_holds_from_the_last_action_on(make_planner, seeded, limit, options):
    controller = ModelPredictiveController(
        make_planner(**options), greedy(), constraints=[limit], generator=seeded(), replan_every=2
    )
    state, last = torch.ones(3, 2), None
    for _ in range(6):
        action = controller.act(state)
        if last is not None:
            assert (action - last).abs().max() <= 0.3 + 1e-5
        assert controller.plan.actions.diff(dim=1).abs().max() <= 0.3 + 1e-5
        state, last = -state, action


@pytest.mark.parametrize(
    "policy", [None, lambda state, generator: torch.where(state[:, :1] > 0, 1.0, -1.0).expand(-1, 2)]
)
@pytest.mark.parametrize("options", [{}, {"action_spline": "linear", "num_knots": 2}, {"action_choices": {1: 3}}])
def test_plan_without_time_for_a_search_holds_limits_too(make_planner, seeded, policy, options):
    model = FunctionModel(lambda state, action: state, greedy().reward, policy=policy)
    own = {"num_policy_samples": 8, "tail": "policy"} if policy else {}
    planner, state = make_planner(**options | own), torch.tensor([[1.0], [-1.0]])
    limits = [rate_limit(0.3)]
    loose = planner.plan(model, state, generator=seeded())  # not limited
    plan = planner.plan(model, state, loose, constraints=limits, deadline_ms=0.0, last_action=torch.zeros(2, 2))
    assert plan.info["stopped"] == "deadline" and plan.info["iterations"].tolist() == [0, 0]
    continuous = plan.actions[..., :1] if "action_choices" in options else plan.actions
    assert continuous.diff(dim=1, prepend=torch.zeros(2, 1, continuous.shape[-1])).abs().max() <= 0.3 + 1e-5
    if "action_choices" in options:
        assert torch.isin(plan.actions[..., 1], torch.arange(3.0)).all()


def test_plan_without_time_for_a_search_is_a_spline_too(make_planner, seeded):
    planner = make_planner(action_spline="linear", num_knots=2)
    before = planner.plan(greedy(), torch.ones(2, 1), generator=seeded())
    plan = planner.plan(greedy(), torch.ones(2, 1), before, deadline_ms=0.0)
    assert before.actions.abs().min() > 0.1  # the shifted plan ends in a zero and therefore bends
    torch.testing.assert_close(plan.actions.diff(n=2, dim=1), torch.zeros(2, 4, 2), atol=1e-6, rtol=0)


def test_rate_limit_counts_from_the_given_last_action(recorder, make_planner, seeded):
    last = torch.tensor([[-0.9, 0.4]])
    plan = make_planner(num_iterations=8, num_samples=512, final="best").plan(
        recorder, torch.zeros(1, 1), constraints=[rate_limit(0.2)], last_action=last, generator=seeded()
    )
    torch.testing.assert_close(plan.action, last + 0.2, atol=0.02, rtol=0)
    assert plan.info["violation"].tolist() == [0.0]  # every candidate holds the limit
    with pytest.raises(ValueError, match="last_action must have shape"):
        make_planner().plan(recorder, torch.zeros(1, 1), constraints=[rate_limit(0.2)], last_action=last[0])


@pytest.mark.parametrize(
    "options", [{}, {"final": "better"}, {"gradient_steps": 3}, {"action_spline": "linear"}, {"overshoot": 2.0}]
)
@pytest.mark.parametrize("deadline_ms", [None, 0.0])
def test_violation_is_zero_where_a_rate_limit_holds(make_planner, seeded, options, deadline_ms):
    last = torch.tensor([[0.31, -0.47], [float("nan")] * 2, [0.05, 0.9]])
    given = {"constraints": [rate_limit(0.1)], "last_action": last, "deadline_ms": deadline_ms}
    plan = make_planner(**options).plan(greedy(), torch.ones(3, 2), generator=seeded(), keep="candidates", **given)
    assert plan.info["violation"].tolist() == [0.0] * 3
    assert all((iteration.violations == 0).all() and iteration.is_feasible.all() for iteration in plan.candidates)


def test_violation_of_a_rate_limit_is_the_excess_that_the_bounds_enforce(make_planner, seeded):
    """The bounds allow 0.5 to 1, so that the first action is at least 0.3 beyond the limit in both dimensions."""
    planner, last = make_planner(action_low=0.5, final="best"), torch.tensor([[0.0, 0.0], [0.5, 0.5]])
    others, start = [lambda rollout: torch.ones(len(rollout.actions))], -torch.ones(2, 2)
    for constraints, other in (([rate_limit(0.2)], 0.0), ([rate_limit(0.2), *others], 1.0)):
        plan = planner.plan(
            greedy(), start, constraints=constraints, last_action=last, generator=seeded(), keep="candidates"
        )
        torch.testing.assert_close(plan.info["violation"], torch.tensor([0.6 + other, other]))
        for iteration in plan.candidates:
            assert (iteration.violations[0] >= 0.6 + other - 1e-6).all()
            assert iteration.is_feasible[1].all() == (not other) and not iteration.is_feasible[0].any()
    late = planner.plan(greedy(), start, constraints=others, last_action=last, deadline_ms=0.0)
    assert late.info["violation"].isnan().all()


def test_rate_limit_is_a_violation_for_other_planners(point, states):
    limit = rate_limit(0.25)
    actions = torch.tensor([[[0.0], [0.5], [0.5]], [[0.1], [0.2], [0.3]]])
    parts = (torch.zeros(2, 3), torch.ones(4), states, states, ())
    rollout = Rollout(point, 2, 1, actions, *parts, lambda: torch.tensor([[0.5], [float("nan")]]))
    torch.testing.assert_close(limit(rollout), torch.tensor([0.25 + 0.25, 0.0]))


def test_rate_limit_refuses_missing_and_wrong_numbers():
    for given in ({}, {"per_step": 0.0}, {"per_second": -1.0, "step_seconds": 0.1}, {"per_step": [[0.1]]}):
        with pytest.raises(ValueError, match="rate limit must be above 0"):
            rate_limit(**given)
    for given in ({"per_second": 1.0}, {"per_step": 0.1, "step_seconds": 0.1}):
        with pytest.raises(ValueError, match="needs both per_second and step_seconds"):
            rate_limit(**given)


def test_smoothness_penalty_counts_the_change_from_the_last_action(make_planner, seeded):
    """Zero is the best action of the task; the penalty pulls the first action towards the last one."""
    model = constant(lambda state, action: -action.square().sum(dim=1))
    objective = learned_return() + 3.0 * smoothness_penalty()
    planner = make_planner(num_iterations=8, horizon=1)

    def first(**given):
        return planner.plan(model, torch.zeros(1, 1), objective=objective, generator=seeded(), **given).action

    assert first().abs().max() < 0.05
    near = torch.full((1, 2), 0.75 * 0.8)  # minimises a² + 3 (a - 0.8)²
    torch.testing.assert_close(first(last_action=torch.full((1, 2), 0.8)), near, atol=0.03, rtol=0)
    previous = Plan.around(torch.full((1, 2, 2), 0.8)).executed(torch.tensor([1]))
    torch.testing.assert_close(first(previous=previous), near, atol=0.03, rtol=0)


def test_last_action_is_unknown_where_a_plan_is_cold_or_another_agent_acted():
    plan = Plan.around(torch.arange(12.0).reshape(2, 3, 2))
    assert plan.last_action.isnan().all()
    after = plan.executed(torch.tensor([1, 2]))
    torch.testing.assert_close(after.last_action, torch.tensor([[0.0, 1.0], [8.0, 9.0]]))
    assert after.aged().last_action.isnan().all()
    cold = after.forget(torch.tensor([True, False]))
    assert cold.last_action[0].isnan().all() and not cold.last_action[1].isnan().any()
    torch.testing.assert_close(after.take(torch.tensor([1])).last_action, torch.tensor([[8.0, 9.0]]))


def test_plan_from_dict_keeps_on_the_cpu_what_a_plan_says_about_time():
    """The device `meta` stands for an accelerator."""
    plan = Plan.around(torch.zeros(2, 3, 1)).executed(torch.ones(2, dtype=torch.long))
    copy = Plan.from_dict(plan.to_dict(), torch.device("meta"))
    for name in ("is_warm", "elapsed", "is_followed"):
        assert torch.equal(getattr(copy, name), getattr(plan, name))
    assert copy.actions.is_meta and copy.last_action.is_meta


@pytest.mark.parametrize("shape", [(6, 2), (3, 6, 2), (3, 4, 2)])
def test_plan_around_a_trajectory_starts_the_search_there(recorder, make_planner, seeded, shape):
    trajectory = torch.rand(shape, generator=seeded(4)) - 0.5
    batch = 1 if len(shape) == 2 else shape[0]
    plan = make_planner(init_std=0.0).plan(recorder, torch.zeros(batch, 1), Plan.around(trajectory), generator=seeded())
    steps = min(6, shape[-2])
    torch.testing.assert_close(plan.mean[:, :steps], trajectory.reshape(batch, -1, 2)[:, :steps])
    assert Plan.around(trajectory.numpy()).source == "plan"
    with pytest.raises(ValueError, match="a trajectory has shape"):
        Plan.around(trajectory.flatten())
    with pytest.raises(ValueError, match=r"with one action or more, got \(2, 0, 2\)"):
        Plan.around(torch.zeros(2, 0, 2))
    with pytest.raises(ValueError, match="must be finite"):
        Plan.around([[0.0, float("nan")]])


def test_scheduler_without_plan_and_policy_acts_in_the_middle_of_the_bounds(point, make_planner):
    class Busy:
        is_idle = False

        def poll(self):
            return None

    low = torch.tensor([[0.0, -1.0]] * 6)
    planner = make_planner(action_low=low, action_high=low + 1.0)
    decision = PlanScheduler(planner, FunctionModel(point.dynamics, point.reward), Busy()).decide(torch.zeros(2, 4))
    torch.testing.assert_close(decision.action, torch.tensor([[0.5, -0.5]] * 2))


@pytest.mark.parametrize("policy", [None, lambda state, generator: torch.full((len(state), 2), 0.8)])
def test_scheduler_without_plan_takes_values_that_exist(point, make_planner, policy):
    """With a plan the action is the plan's; without, the policy's or the middle, at the nearest value."""

    class Busy:
        is_idle = False

        def poll(self):
            return None

    planner = make_planner(action_choices={1: (-2.0, 0.0, 1.0, 5.0)})
    model = FunctionModel(point.dynamics, point.reward, policy=policy)
    action = PlanScheduler(planner, model, Busy()).decide(torch.zeros(2, 4)).action
    assert action.tolist() == [[pytest.approx(0.0 if policy is None else 0.8), 1.0]] * 2
    whole = make_planner(action_choices=(2.0, 3.0, 4.0))  # none lies within action_low and action_high
    action = PlanScheduler(whole, model, Busy()).decide(torch.zeros(2, 4)).action
    assert action.tolist() == [[3.0 if policy is None else 2.0] * 2] * 2


def test_penalties_see_actions_and_not_knots(recorder, make_planner, seeded):
    planner = make_planner(
        action_spline="zero", num_knots=2, init_mean=0.5, init_std=0.0, num_iterations=1, final="better"
    )
    model = constant(lambda state, action: torch.zeros(len(state)))
    plan = planner.plan(model, torch.zeros(1, 1), objective=action_penalty(), generator=seeded())
    assert plan.expected_return.item() == pytest.approx(-6 * 2 * 0.25)
