"""Receding-horizon control: what is kept between steps, and what forgets it."""

import itertools

import pytest
import torch

from latentplan.planning import ModelPredictiveController, action_penalty, goal_term


@pytest.fixture
def make_controller(point, make_planner, seeded):
    def make(replan_every=1, seed=0, **options):
        return ModelPredictiveController(
            make_planner(**options), point, generator=seeded(seed), replan_every=replan_every
        )

    return make


def test_acting_is_planning_with_the_last_plan(point, states, make_controller, make_planner, seeded):
    controller, planner, generator = make_controller(), make_planner(), seeded()
    first = planner.plan(point, states, generator=generator)
    torch.testing.assert_close(controller.act(states), first.action)
    second = planner.plan(point, states + 0.1, first, generator=generator)
    torch.testing.assert_close(controller.act(states + 0.1), second.action)


def test_reset_forgets_everything(states, make_controller):
    controller = make_controller(num_iterations=4, warm_start_iterations=1, keep_elite_fraction=0.5)
    controller.act(states)
    controller.act(states)
    assert controller.plan.info["iterations"].tolist() == [1] * 5
    controller.reset()
    assert controller.plan is None
    controller.act(states)
    assert controller.plan.info["iterations"].tolist() == [4] * 5


def test_reset_by_mask_forgets_those_environments_only(states, make_controller):
    controller = make_controller(num_iterations=4, warm_start_iterations=1)
    controller.reset(torch.tensor([True, False]))  # nothing to forget yet
    controller.act(states)
    controller.reset(torch.tensor([0, 1, 0, 0, 1]).bool())
    controller.act(states)
    assert controller.plan.info["iterations"].tolist() == [1, 4, 1, 1, 4]
    controller.act(states)
    assert controller.plan.info["iterations"].tolist() == [1] * 5


def test_a_plan_is_executed_for_as_long_as_asked(point, states, make_controller):
    controller = make_controller(replan_every=3)
    actions = [controller.act(states) for _ in range(3)]
    plan = controller.plan
    torch.testing.assert_close(torch.stack(actions, dim=1), plan.actions[:, :3])
    controller.act(states)
    assert controller.plan.mean is not plan.mean


def test_the_warm_start_skips_all_that_was_executed(states, make_controller):
    controller = make_controller(replan_every=3)
    for _ in range(3):
        controller.act(states)
    last = controller.plan
    frozen = make_controller(replan_every=3, init_std=0.0, num_iterations=1, keep_elite_fraction=0.2)
    frozen.plan = last
    frozen.act(states)
    torch.testing.assert_close(frozen.plan.mean[:, :3], last.actions[:, 3:])
    assert (frozen.plan.mean[:, 3:] == 0).all()


def test_a_reset_environment_is_replanned_at_once_and_the_others_go_on(states, make_controller):
    controller = make_controller(replan_every=4)
    controller.act(states)
    before = controller.plan
    controller.reset(torch.tensor([0, 0, 1, 0, 0]).bool())
    action = controller.act(states)
    others = torch.tensor([0, 1, 3, 4])
    torch.testing.assert_close(action[others], before.actions[others, 1])
    torch.testing.assert_close(action[2], controller.plan.actions[2, 0])
    assert controller.plan.elapsed.tolist() == [2, 2, 1, 2, 2]


def test_another_objective_takes_effect_at_once_and_keeps_the_plan_as_its_start(states, make_controller):
    controller = make_controller(replan_every=4, num_samples=256, num_iterations=6, num_elites=16)
    first = controller.act(states)
    controller.set_objective(action_penalty())
    calm = controller.act(states)
    assert calm.abs().max() < 0.1 < first.abs().max()
    controller.set_objective(goal_term(torch.tensor([3.0, 3.0]), select=lambda state: state[:, :2]))
    assert (controller.act(torch.zeros(5, 4)) > 0.3).all()


def test_another_number_of_environments_starts_cold(states, make_controller):
    controller = make_controller(num_iterations=4, warm_start_iterations=1)
    controller.act(states)
    assert controller.act(states[:2]).shape == (2, 2)
    assert controller.plan.info["iterations"].tolist() == [4, 4]


def test_latency_is_measured(states, make_controller):
    controller = make_controller()
    assert controller.latency == {}
    for _ in range(5):
        controller.act(states)
    latency = controller.latency
    assert 0 < latency["p50_ms"] <= latency["p95_ms"] <= latency["p99_ms"]


def test_more_steps_per_plan_than_it_has_are_refused(make_controller):
    with pytest.raises(ValueError, match=r"replan_every \(7\)"):
        make_controller(replan_every=7)


def test_deciding_for_some_environments_leaves_the_others_plans_to_age(states, make_controller):
    controller, reference = make_controller(), make_controller()
    reference.act(states)
    controller.act(states)
    before = controller.plan
    where = torch.tensor([0, 1, 0, 1, 1]).bool()
    action = controller.act_where(states + 0.1, where)
    torch.testing.assert_close(action, reference.act(states + 0.1)[where], atol=1e-5, rtol=0)
    assert controller.plan.elapsed.tolist() == [2, 1, 2, 1, 1]
    assert torch.equal(controller.plan.actions[~where], before.actions[~where])


def test_plans_for_an_old_objective_are_not_followed_where_nobody_planned_since(states, make_controller):
    controller = make_controller()
    controller.act(states)
    controller.set_objective(action_penalty())
    controller.act_where(states, torch.tensor([0, 1, 0, 0, 1]).bool())
    _, is_left = controller.follow()
    assert is_left.tolist() == [False, True, False, False, True]
    controller.act(states)
    assert controller.follow()[1].all()


def test_the_warm_start_skips_what_others_did(states, make_controller):
    controller = make_controller()
    controller.act(states)
    last = controller.plan
    frozen = make_controller(init_std=0.0, num_iterations=1)
    frozen.plan = last
    for _ in range(2):
        frozen.skip()
    frozen.act(states)
    torch.testing.assert_close(frozen.plan.mean[:, :3], last.actions[:, 3:])


def test_a_plan_that_has_run_out_is_no_warm_start(states, make_controller):
    controller = make_controller(num_iterations=4, warm_start_iterations=1)
    controller.skip()  # nothing to age yet
    controller.act(states)
    for _ in range(4):
        controller.skip()
    assert controller.plan.is_warm.all()
    controller.act_where(states, torch.tensor([1, 0, 0, 0, 0]).bool())  # the others' plans of 6 steps run out
    assert controller.plan.is_warm.tolist() == [True, False, False, False, False]
    controller.act(states)
    assert controller.plan.info["iterations"].tolist() == [1, 4, 4, 4, 4]


def test_deciding_for_some_first_leaves_the_others_cold(states, make_controller, seeded):
    controller = make_controller(num_iterations=4, warm_start_iterations=1)
    controller.generator = [seeded(seed) for seed in range(5)]
    controller.act_where(states, torch.tensor([0, 0, 1, 0, 0]).bool())
    assert controller.plan.is_warm.tolist() == [False, False, True, False, False]
    with pytest.raises(ValueError, match="at least one"):
        controller.act_where(states, torch.zeros(5))


def test_an_objective_is_planned_for_as_far_ahead_as_it_asks_for(states, make_controller):
    """What is left of the last plan is where the next search starts, cut or filled with zeros."""
    controller = make_controller(goal_horizon=9, init_std=0.0, num_iterations=1)
    controller.act(states)
    own = controller.plan.actions
    controller.set_objective(action_penalty())
    controller.act(states)
    assert controller.plan.actions.shape == (5, 9, 2)
    torch.testing.assert_close(controller.plan.mean[:, :5], own[:, 1:])
    assert (controller.plan.mean[:, 5:] == 0).all()
    further = controller.plan.actions
    controller.set_objective(None)
    controller.act(states)
    torch.testing.assert_close(controller.plan.mean, further[:, 1:7])


def test_a_plan_of_another_length_is_no_plan_of_the_other_environments(states, make_controller):
    controller = make_controller(goal_horizon=9)
    controller.act(states)
    controller.set_objective(action_penalty())
    some = torch.tensor([1, 0, 0, 1, 0]).bool()
    controller.act_where(states, some)
    assert controller.plan.is_warm.tolist() == some.tolist()
    assert controller.follow()[1].tolist() == some.tolist()


def test_no_more_is_executed_than_the_shorter_plan_holds(make_controller):
    with pytest.raises(ValueError, match="horizon \\(3\\)"):
        make_controller(replan_every=4, goal_horizon=3)


def test_a_reset_elsewhere_leaves_the_random_stream_of_an_environment_alone(states, point, make_planner, seeded):
    def actions(resets):
        generators = [seeded(row) for row in range(5)]
        controller = ModelPredictiveController(make_planner(), point, generator=generators, replan_every=3)
        chosen = []
        for step in range(6):
            chosen.append(controller.act(states + 0.1 * step)[1])
            if step == 1 and resets:
                controller.reset(torch.tensor([True, False, False, False, False]))
        return torch.stack(chosen)

    torch.testing.assert_close(actions(resets=True), actions(resets=False))


def test_environments_that_share_a_stream_draw_on(point, states, make_planner, seeded):
    generator = seeded()
    controller = ModelPredictiveController(make_planner(), point, generator=[generator] * 5, replan_every=2)
    controller.act(states)
    controller.reset(torch.tensor([True, False, False, False, False]))
    drawn = []
    for _ in range(6):
        controller.act(states)
        drawn.append(generator.get_state())
    assert not any(torch.equal(before, after) for before, after in itertools.pairwise(drawn))


def test_a_search_that_fails_draws_nothing_for_those_who_wait(point, states, make_planner, seeded):
    generators = [seeded(row) for row in range(5)]
    controller = ModelPredictiveController(make_planner(), point, generator=generators, replan_every=3)
    controller.act(states)
    controller.reset(torch.tensor([True, False, False, False, False]))
    before = [generator.get_state() for generator in generators]
    point.step = lambda state, action: 1 / 0
    with pytest.raises(ZeroDivisionError):
        controller.act(states)
    assert all(torch.equal(kept, now.get_state()) for kept, now in zip(before[1:], generators[1:], strict=True))


def test_what_cannot_be_decided_leaves_the_plans_as_they_are(states, point, make_planner):
    goals = torch.randn(5, 4)
    controller = ModelPredictiveController(make_planner(), point, objective=goal_term(goals))
    controller.act(states)
    plan = controller.plan
    with pytest.raises(ValueError, match="the goal must have shape"):
        controller.act_where(states, torch.tensor([True, False, True, False, False]))
    assert controller.plan is plan


def test_a_plan_goes_on_in_another_precision(states, make_controller):
    controller = make_controller(keep_elite_fraction=0.5)
    assert controller.act(states.double()).dtype == torch.float64
    assert controller.act(states).dtype == torch.float32
    assert controller.act(states.double()).dtype == torch.float64
