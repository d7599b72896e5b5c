"""Looking inside a search: the candidates that a plan keeps, and the callback after each iteration."""

import pytest
import torch

from latentplan.planning import FunctionModel, ModelPredictiveController, risk, terminal_value

RICH = {"num_policy_samples": 6, "keep_elite_fraction": 0.3, "final": "better", "noise_beta": 1.0}


@pytest.mark.parametrize("options", [{}, RICH, {"action_spline": "linear"}, {"action_choices": {1: 3}}])
def test_keep_returns_every_iteration_and_changes_no_plan(point, states, make_planner, seeded, options):
    planner, seen = make_planner(**options), []
    plain = planner.plan(point, states, generator=seeded())
    kept = planner.plan(point, states, generator=seeded(), keep="candidates", callback=seen.append)
    assert torch.equal(plain.actions, kept.actions) and plain.candidates == ()
    assert [iteration.index for iteration in kept.candidates] == [0, 1, 2] == [iteration.index for iteration in seen]
    for iteration, shown in zip(kept.candidates, seen, strict=True):
        assert torch.equal(iteration.actions, shown.actions) and torch.equal(iteration.elites, shown.elites)
    for iteration, elite_return in zip(kept.candidates, kept.info["elite_return"].unbind(dim=1), strict=True):
        batch, num = iteration.returns.shape
        assert iteration.actions.shape == (batch, num, 6, 2) and iteration.is_feasible.all()
        assert iteration.violations is None and iteration.states is None
        assert iteration.mean.shape == iteration.std.shape == (5, 6, 2)
        torch.testing.assert_close(iteration.elite_return, elite_return)
        assert iteration.elites.shape == (batch, planner.num_elites, 6, 2)
    torch.testing.assert_close(kept.candidates[-1].mean, kept.mean)


def test_kept_candidates_have_their_true_returns_and_states(point, states, make_planner, seeded):
    plan = make_planner().plan(point, states, generator=seeded(), keep="states")
    for iteration in plan.candidates:
        assert iteration.states.shape == (5, 64, 6, 4)
        state, total = states[2], 0.0
        for action, imagined in zip(iteration.actions[2, 7], iteration.states[2, 7], strict=True):
            total = total + point.reward(state[None], action[None])
            state = point.dynamics(state[None], action[None])[0]
            torch.testing.assert_close(imagined, state)
        torch.testing.assert_close(iteration.returns[2, 7], (total + point.value(state[None]))[0])


def test_kept_states_are_pytrees_and_have_particles(point, states, make_planner, seeded):
    class Named:
        num_particles = 3

        def step(self, state, action):
            moved = point.dynamics(state["body"], action)
            return {"body": moved, "time": state["time"] + 1}, point.reward(state["body"], action)

    start = {"body": states, "time": torch.zeros(5)}
    plan = make_planner(num_iterations=1).plan(Named(), start, generator=seeded(), keep="states")
    kept = plan.candidates[0].states
    assert kept["body"].shape == (5, 64, 3, 6, 4) and kept["time"].shape == (5, 64, 3, 6)
    torch.testing.assert_close(kept["time"][0, 0, 0], torch.arange(1.0, 7.0))
    plan = make_planner(num_iterations=1).plan(
        point, states, objective=risk(terminal_value(), num_particles=2), generator=seeded(), keep="states"
    )
    assert plan.candidates[0].states.shape == (5, 64, 2, 6, 4)


def test_kept_candidates_say_which_are_feasible(point, states, make_planner, seeded):
    constraints = [lambda rollout: rollout.actions[:, 0, 0] - 0.1]
    plan = make_planner().plan(point, states, constraints=constraints, generator=seeded(), keep="candidates")
    for iteration in plan.candidates:
        assert torch.equal(iteration.is_feasible, iteration.actions[:, :, 0, 0] <= 0.1)
        assert ((iteration.violations == 0) == iteration.is_feasible).all()
    nan = FunctionModel(point.dynamics, lambda state, action: torch.where(action[:, 0] > 0, torch.nan, action[:, 1]))
    iteration = make_planner().plan(nan, states, generator=seeded(), keep="candidates").candidates[0]
    assert torch.equal(iteration.is_feasible, (iteration.actions[..., 0] <= 0).all(dim=2))


@pytest.mark.parametrize("options", [{}, {"constraint_penalty": 0.1}, {"num_iterations": 1}])
def test_mean_of_the_elites_of_an_iteration_is_the_mean_of_the_search(point, states, make_planner, seeded, options):
    def push_apart(rollout):  # no candidate satisfies it
        return 20.0 + rollout.actions[:, :, 0].sum(dim=1)

    planner = make_planner(**RICH | {"smoothing": 1.0} | options)
    for constraints in ([], [push_apart]):
        plan = planner.plan(point, states, generator=seeded(), constraints=constraints, keep="candidates")
        for iteration in plan.candidates:
            assert iteration.violations is None or not iteration.is_feasible.any()
            torch.testing.assert_close(iteration.elites.mean(dim=1), iteration.mean)


def test_elites_of_an_iteration_are_nan_where_too_few_candidates_have_a_finite_return(
    point, states, make_planner, seeded
):
    nan = FunctionModel(point.dynamics, lambda state, action: torch.where(action[:, 0] > 0, torch.nan, action[:, 1]))
    iteration = make_planner(horizon=3).plan(nan, states, generator=seeded(), keep="candidates").candidates[0]
    num_finite = iteration.is_feasible.sum(dim=1).clamp_max(8)
    assert torch.equal(torch.isfinite(iteration.elites).all(dim=(2, 3)).sum(dim=1), num_finite)


def test_candidates_follow_the_environments_that_are_taken(point, states, make_planner, seeded):
    plan = make_planner().plan(point, states, generator=seeded(), keep="states")
    taken = plan.take(torch.tensor([3, 0]))
    assert torch.equal(taken.candidates[1].states, plan.candidates[1].states[[3, 0]])
    assert taken.candidates[1].index == 1


def test_controller_keeps_candidates_and_calls_back(point, states, make_planner, seeded):
    seen = []
    controller = ModelPredictiveController(
        make_planner(), point, generator=seeded(), keep="candidates", callback=lambda it: seen.append(it.index)
    )
    controller.act(states)
    assert len(controller.plan.candidates) == 3 and seen == [0, 1, 2]


def test_keep_is_refused_when_unknown(point, states, make_planner):
    with pytest.raises(ValueError, match="keep must be candidates, states or None, got 'elites'"):
        make_planner().plan(point, states, keep="elites")


def test_callback_may_write_into_what_it_is_given(point, states, make_planner, seeded):
    def normalise(iteration):
        for tensor in (iteration.returns, iteration.actions, iteration.mean, iteration.elites, iteration.elite_return):
            tensor.zero_()

    plain = make_planner().plan(point, states, generator=seeded())
    shown = make_planner().plan(point, states, generator=seeded(), callback=normalise)
    assert torch.equal(plain.actions, shown.actions)
    assert torch.equal(plain.expected_return, shown.expected_return)


def test_plans_and_iterations_are_compared_by_identity(point, states, make_planner, seeded):
    plan = make_planner().plan(point, states, generator=seeded(), keep="candidates")
    assert plan in [plan] and plan != plan.take(torch.arange(5))
    assert len({plan, *plan.candidates}) == 1 + len(plan.candidates)
