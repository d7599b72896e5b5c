"""Receding-horizon control: the plan that the controller keeps between steps, and the calls that drop it."""

import dataclasses
import inspect
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


def test_act_plans_with_the_last_plan(point, states, make_controller, make_planner, seeded):
    controller, planner, generator = make_controller(), make_planner(), seeded()
    first = planner.plan(point, states, generator=generator)
    torch.testing.assert_close(controller.act(states), first.action)
    second = planner.plan(point, states + 0.1, first, generator=generator)
    torch.testing.assert_close(controller.act(states + 0.1), second.action)


def test_planner_with_the_arguments_of_the_protocol_alone_is_called_with_no_other(point, states, make_planner, seeded):
    inner = make_planner()

    class OwnPlanner:
        def __getattr__(self, name):
            return getattr(inner, name)

        def plan(
            self, model, state, previous=None, *, objective=None, constraints=(), generator=None, deadline_ms=None
        ):
            goals = {"objective": objective, "constraints": constraints}
            return inner.plan(model, state, previous, generator=generator, deadline_ms=deadline_ms, **goals)

    controller = ModelPredictiveController(OwnPlanner(), point, generator=seeded(), keep="candidates")
    expected = ModelPredictiveController(inner, point, generator=seeded(), keep="candidates")
    assert torch.equal(controller.act(states), expected.act(states))
    assert controller.plan.candidates == () and len(expected.plan.candidates) > 0
    everywhere = torch.ones(len(states), dtype=torch.bool)
    last = torch.zeros(len(states), 2)
    assert torch.equal(controller.act_where(states, everywhere, last), expected.act_where(states, everywhere, last))


def test_reset_forgets_the_plan(states, make_controller):
    controller = make_controller(num_iterations=4, warm_start_iterations=1, keep_elite_fraction=0.5)
    controller.act(states)
    controller.act(states)
    assert controller.plan.info["iterations"].tolist() == [1] * 5
    controller.reset()
    assert controller.plan is None
    controller.act(states)
    assert controller.plan.info["iterations"].tolist() == [4] * 5


def test_reset_with_mask_forgets_only_masked_environments(states, make_controller):
    controller = make_controller(num_iterations=4, warm_start_iterations=1)
    controller.reset(torch.tensor([True, False]))  # nothing to forget yet
    controller.act(states)
    controller.reset(torch.tensor([0, 1, 0, 0, 1]).bool())
    controller.act(states)
    assert controller.plan.info["iterations"].tolist() == [1, 4, 1, 1, 4]
    controller.act(states)
    assert controller.plan.info["iterations"].tolist() == [1] * 5


@pytest.mark.parametrize("replan_every", [0, 7, 2.5])
def test_controller_refuses_a_replan_every_that_counts_no_actions(make_controller, replan_every):
    with pytest.raises(ValueError, match=r"replan_every \(.*\) must be a whole number in 1 to the horizon"):
        make_controller(replan_every=replan_every)


def test_controller_executes_replan_every_actions_of_a_plan(point, states, make_controller):
    controller = make_controller(replan_every=3)
    actions = [controller.act(states) for _ in range(3)]
    plan = controller.plan
    torch.testing.assert_close(torch.stack(actions, dim=1), plan.actions[:, :3])
    controller.act(states)
    assert controller.plan.mean is not plan.mean


def test_warm_start_skips_all_executed_actions(states, make_controller):
    controller = make_controller(replan_every=3)
    for _ in range(3):
        controller.act(states)
    last = controller.plan
    frozen = make_controller(replan_every=3, init_std=0.0, num_iterations=1, keep_elite_fraction=0.2)
    frozen.plan = last
    frozen.act(states)
    torch.testing.assert_close(frozen.plan.mean[:, :3], last.actions[:, 3:])
    assert (frozen.plan.mean[:, 3:] == 0).all()


def test_controller_replans_only_the_environment_that_was_reset(states, make_controller):
    controller = make_controller(replan_every=4)
    controller.act(states)
    before = controller.plan
    controller.reset(torch.tensor([0, 0, 1, 0, 0]).bool())
    action = controller.act(states)
    others = torch.tensor([0, 1, 3, 4])
    torch.testing.assert_close(action[others], before.actions[others, 1])
    torch.testing.assert_close(action[2], controller.plan.actions[2, 0])
    assert controller.plan.elapsed.tolist() == [2, 2, 1, 2, 2]


def test_set_objective_replans_at_once_from_the_last_plan(states, make_controller):
    controller = make_controller(replan_every=4, num_samples=256, num_iterations=6, num_elites=16)
    first = controller.act(states)
    controller.set_objective(action_penalty())
    calm = controller.act(states)
    assert calm.abs().max() < 0.1 < first.abs().max()
    controller.set_objective(goal_term(torch.tensor([3.0, 3.0]), select=lambda state: state[:, :2]))
    assert (controller.act(torch.zeros(5, 4)) > 0.3).all()


def test_controller_starts_cold_when_the_number_of_environments_changes(states, make_controller):
    controller = make_controller(num_iterations=4, warm_start_iterations=1)
    controller.act(states)
    assert controller.act(states[:2]).shape == (2, 2)
    assert controller.plan.info["iterations"].tolist() == [4, 4]


def test_controller_measures_latency_quantiles(states, make_controller):
    controller = make_controller()
    assert controller.latency == {}
    for _ in range(5):
        controller.act(states)
    latency = controller.latency
    assert 0 < latency["p50_ms"] <= latency["p95_ms"] <= latency["p99_ms"]


def test_controller_refuses_replan_every_beyond_the_horizon(make_controller):
    with pytest.raises(ValueError, match=r"replan_every \(7\)"):
        make_controller(replan_every=7)


def test_act_where_ages_the_plans_of_other_environments(states, make_controller):
    controller, reference = make_controller(), make_controller()
    reference.act(states)
    controller.act(states)
    before = controller.plan
    where = torch.tensor([0, 1, 0, 1, 1]).bool()
    action = controller.act_where(states + 0.1, where)
    torch.testing.assert_close(action, reference.act(states + 0.1)[where], atol=1e-5, rtol=0)
    assert controller.plan.elapsed.tolist() == [2, 1, 2, 1, 1]
    assert torch.equal(controller.plan.actions[~where], before.actions[~where])


def test_next_actions_marks_plans_of_an_old_objective_as_invalid(states, make_controller):
    controller = make_controller()
    controller.act(states)
    controller.set_objective(action_penalty())
    controller.act_where(states, torch.tensor([0, 1, 0, 0, 1]).bool())
    _, is_left = controller.next_actions()
    assert is_left.tolist() == [False, True, False, False, True]
    controller.act(states)
    assert controller.next_actions()[1].all()


def test_warm_start_skips_steps_of_another_agent(states, make_controller):
    controller = make_controller()
    controller.act(states)
    last = controller.plan
    frozen = make_controller(init_std=0.0, num_iterations=1)
    frozen.plan = last
    for _ in range(2):
        frozen.skip()
    frozen.act(states)
    torch.testing.assert_close(frozen.plan.mean[:, :3], last.actions[:, 3:])


def test_search_starts_cold_when_the_plan_has_run_out(states, make_controller):
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


def test_act_where_leaves_environments_without_a_plan_cold(states, make_controller, seeded):
    controller = make_controller(num_iterations=4, warm_start_iterations=1)
    controller.generator = [seeded(seed) for seed in range(5)]
    controller.act_where(states, torch.tensor([0, 0, 1, 0, 0]).bool())
    assert controller.plan.is_warm.tolist() == [False, False, True, False, False]
    with pytest.raises(ValueError, match="at least one"):
        controller.act_where(states, torch.zeros(5))


def test_controller_changes_plan_length_with_the_objective(states, make_controller):
    """The rest of the last plan, cut or filled with zeros, starts the next search."""
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


def test_act_where_leaves_others_cold_when_plans_have_another_length(states, make_controller):
    controller = make_controller(goal_horizon=9)
    controller.act(states)
    controller.set_objective(action_penalty())
    some = torch.tensor([1, 0, 0, 1, 0]).bool()
    controller.act_where(states, some)
    assert controller.plan.is_warm.tolist() == some.tolist()
    assert controller.next_actions()[1].tolist() == some.tolist()


def test_controller_refuses_replan_every_beyond_goal_horizon(make_controller):
    with pytest.raises(ValueError, match="horizon \\(3\\)"):
        make_controller(replan_every=4, goal_horizon=3)


def test_actions_of_an_environment_are_the_same_when_another_is_reset(states, point, make_planner, seeded):
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


def test_shared_stream_advances_at_every_replan(point, states, make_planner, seeded):
    generator = seeded()
    controller = ModelPredictiveController(make_planner(), point, generator=[generator] * 5, replan_every=2)
    controller.act(states)
    controller.reset(torch.tensor([True, False, False, False, False]))
    drawn = []
    for _ in range(6):
        controller.act(states)
        drawn.append(generator.get_state())
    assert not any(torch.equal(before, after) for before, after in itertools.pairwise(drawn))


def test_failed_search_draws_nothing_from_streams_of_waiting_environments(point, states, make_planner, seeded):
    generators = [seeded(row) for row in range(5)]
    controller = ModelPredictiveController(make_planner(), point, generator=generators, replan_every=3)
    controller.act(states)
    controller.reset(torch.tensor([True, False, False, False, False]))
    before = [generator.get_state() for generator in generators]
    point.step = lambda state, action: 1 / 0
    with pytest.raises(ZeroDivisionError):
        controller.act(states)
    assert all(torch.equal(kept, now.get_state()) for kept, now in zip(before[1:], generators[1:], strict=True))


def test_act_where_keeps_the_plans_when_the_search_fails(states, point, make_planner):
    goals = torch.randn(5, 4)
    controller = ModelPredictiveController(make_planner(), point, objective=goal_term(goals))
    controller.act(states)
    plan = controller.plan
    with pytest.raises(ValueError, match="the goal must have shape"):
        controller.act_where(states, torch.tensor([True, False, True, False, False]))
    assert controller.plan is plan


def test_controller_continues_a_plan_in_another_precision(states, make_controller):
    controller = make_controller(keep_elite_fraction=0.5)
    assert controller.act(states.double()).dtype == torch.float64
    assert controller.act(states).dtype == torch.float32
    assert controller.act(states.double()).dtype == torch.float64


@dataclasses.dataclass
class Body:
    position: torch.Tensor
    velocity: torch.Tensor


class BodyModel:
    def step(self, state, action):
        velocity = state.velocity + 0.3 * action
        return Body(state.position + velocity, velocity), -state.position.square().sum(dim=1)


def test_act_where_takes_a_dataclass_state_at_the_first_call(make_planner, seeded):
    controller = ModelPredictiveController(make_planner(), BodyModel(), generator=seeded())
    body = Body(torch.ones(3, 2), torch.zeros(3, 2))
    assert controller.act_where(body, torch.tensor([True, False, True])).shape == (2, 2)


def test_controller_names_masks_of_another_shape(states, make_controller):
    controller = make_controller()
    controller.act(states)
    with pytest.raises(ValueError, match=r"mask must have shape \(5,\), got \(1,\)"):
        controller.reset(torch.tensor([True]))
    with pytest.raises(TypeError, match=r"mask must be a tensor of shape \(5,\), got list"):
        controller.reset([True] * 5)
    with pytest.raises(ValueError, match=r"where must have shape \(5,\), got \(2,\)"):
        controller.act_where(states, torch.tensor([True, False]))
    assert controller.plan.is_warm.all()


def test_signature_of_the_controller_is_that_of_its_constructor():
    names = list(inspect.signature(ModelPredictiveController).parameters)
    assert names[:3] == ["planner", "model", "objective"] and "replan_every" in names and "args" not in names
