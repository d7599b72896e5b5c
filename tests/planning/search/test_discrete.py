"""Discrete and mixed actions: the elites refit the probabilities, and everybody sees only values that exist."""

import numpy as np
import pytest
import torch

from latentplan.planning import CEMPlanner, FunctionModel, ModelPredictiveController, check_model, rate_limit


def still(reward):
    return FunctionModel(lambda state, action: state, reward)


@pytest.mark.parametrize("options", [{}, {"final": "better", "noise_beta": 2.0, "keep_elite_fraction": 0.5}])
def test_search_finds_the_best_value_of_every_step(make_planner, seeded, options):
    """The state counts the steps; the best value of step t is (2 t + environment) mod 5."""

    def reward(state, action):
        return -((2 * state[:, 0] + state[:, 1]) % 5 - action[:, 0]).abs().gt(0.5).float()

    model = FunctionModel(lambda state, action: state + torch.tensor([1.0, 0.0]), reward)
    planner = make_planner(action_dim=1, action_choices=5, num_samples=200, num_elites=20, num_iterations=8, **options)
    states = torch.tensor([[0.0, 0.0], [0.0, 1.0], [0.0, 4.0]])
    plan = planner.plan(model, states, generator=seeded())
    steps = torch.arange(6.0)
    torch.testing.assert_close(plan.actions[..., 0], (2 * steps + states[:, 1:]) % 5)
    assert plan.info["probabilities"].shape == (3, 6, 1, 5)
    assert (plan.info["probabilities"].amax(dim=-1) > 0.8).all()
    torch.testing.assert_close(plan.info["probabilities"].sum(dim=-1), torch.ones(3, 6, 1))


@pytest.mark.parametrize("num_values", [5, 50, 1000])
def test_probability_gathers_at_the_best_of_many_values(make_planner, seeded, num_values):
    """The best value is 0.7; neighbours are almost as good, so that the search can come closer step by step."""
    values = torch.linspace(0.0, 1.0, num_values).tolist()
    model = still(lambda state, action: -(action[:, 0] - 0.7).abs())
    planner = make_planner(action_dim=1, horizon=1, action_choices=values, num_samples=256, num_iterations=10)
    plan = planner.plan(model, torch.zeros(1, 1), generator=seeded())
    near = (torch.tensor(values) - 0.7).abs() <= 0.06
    assert plan.info["probabilities"][0, 0, 0][near].sum() > 0.7


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"final": "better", "keep_elite_fraction": 0.5, "noise_beta": 2.0, "white_noise_share": 0.5},
        {"temperature": 0.2, "adapt_std": False, "smoothing": 1.0},
        {"action_spline": "linear", "num_knots": 3},
        {"gradient_steps": 3},
        {"num_policy_samples": 8, "final": "better", "tail": "policy"},
    ],
)
def test_models_and_plans_see_only_values_that_exist(make_planner, seeded, options):
    seen = []

    def reward(state, action):
        seen.append(action.detach())
        return -(action - torch.tensor([0.4, 2.2])).square().sum(dim=1)

    model = still(reward)
    if "num_policy_samples" in options:
        model.policy = lambda state, generator: torch.full((len(state), 2), 0.9)
    planner = make_planner(action_choices={1: (-1.0, 0.5, 3.0)}, **options)
    controller = ModelPredictiveController(planner, model, generator=seeded())
    for _ in range(3):
        action = controller.act(torch.zeros(4, 1))
        seen += [action, *controller.plan.actions, *controller.plan.mean]
    values = torch.cat(seen)
    assert torch.isin(values[:, 1], torch.tensor([-1.0, 0.5, 3.0])).all()
    assert (values[:, 0].abs() <= 1.0).all() and len(values[:, 0].unique()) > 20


def test_mixed_actions_find_both_optima(make_planner, seeded):
    model = still(lambda state, action: -(action[:, 0] - 0.37).square() - (action[:, 1] != 2).float())
    planner = make_planner(action_choices={1: 4}, num_samples=128, num_iterations=8, horizon=2)
    plan = planner.plan(model, torch.zeros(2, 1), generator=seeded())
    torch.testing.assert_close(plan.actions[..., 0], torch.full((2, 2), 0.37), atol=0.03, rtol=0)
    assert (plan.actions[..., 1] == 2).all()


def test_values_of_a_cold_search_are_drawn_alike_and_a_warm_one_prefers_the_last(make_planner, seeded):
    seen = []
    model = still(lambda state, action: (seen.append(action[:, 0].clone()), torch.zeros(len(state)))[1])
    planner = make_planner(action_dim=1, action_choices=4, horizon=1, num_samples=8000, num_iterations=1)
    plan = planner.plan(model, torch.zeros(1, 1), generator=seeded())
    shares = torch.bincount(seen[0].long(), minlength=4) / 8000
    torch.testing.assert_close(shares, torch.full((4,), 0.25), atol=0.02, rtol=0)
    seen.clear()
    hold = make_planner(action_dim=1, action_choices=4, horizon=1, num_samples=8000, num_iterations=1, tail="hold")
    hold.plan(model, torch.zeros(1, 1), plan, generator=seeded())
    shares = torch.bincount(seen[0].long(), minlength=4) / 8000
    assert shares.amax().item() == pytest.approx(0.5 + 0.5 / 4, abs=0.02)


def test_values_of_a_cold_search_are_drawn_alike_at_every_step_with_the_default_noise(seeded):
    seen = []
    model = still(lambda state, action: torch.zeros(len(state)))
    model.rollout = lambda state, actions: (seen.append(actions.long()), (actions[..., 0] * 0, state))[1]
    planner = CEMPlanner(action_dim=1, horizon=8, action_choices=5, num_samples=20_000, num_iterations=1)
    planner.plan(model, torch.zeros(1, 1), generator=seeded())
    shares = torch.nn.functional.one_hot(seen[0][..., 0]).float().mean(dim=0)  # (step, value)
    # 0.01 is more than three standard deviations of a share of 10,000 independent samples of each kind of noise.
    torch.testing.assert_close(shares, torch.full((8, 5), 0.2), atol=0.01, rtol=0)


def test_coloured_noise_keeps_a_value_for_several_steps(make_planner, seeded):
    def changes(beta):
        seen = []
        model = still(lambda state, action: torch.zeros(len(state)))
        model.rollout = lambda state, actions: (seen.append(actions), (actions[..., 0] * 0, state))[1]
        planner = make_planner(action_dim=1, action_choices=3, horizon=12, noise_beta=beta, num_iterations=1)
        planner.plan(model, torch.zeros(1, 1), generator=seeded())
        return (seen[0].diff(dim=1) != 0).float().mean()

    assert changes(2.0) < 0.8 * changes(0.0)


def test_environment_plans_alone_as_in_a_batch(make_planner, seeded):
    model = still(lambda state, action: -(action - state[:, :2]).square().sum(dim=1))
    states = torch.tensor([[0.3, 1.0], [-0.6, 3.0], [0.9, 0.0]])
    planner = make_planner(action_choices={1: 4})
    together = planner.plan(model, states, generator=[seeded(i) for i in range(3)])
    for row in range(3):
        alone = planner.plan(model, states[row : row + 1], generator=seeded(row))
        torch.testing.assert_close(alone.actions[0], together.actions[row])


def test_rate_limit_leaves_discrete_dimensions_alone(make_planner, seeded):
    model = still(lambda state, action: action.sum(dim=1))
    plan = make_planner(action_choices={1: 5}, num_iterations=8, num_samples=256).plan(
        model, torch.zeros(1, 1), constraints=[rate_limit(0.1)], last_action=torch.zeros(1, 2), generator=seeded()
    )
    assert plan.action[0, 0].item() == pytest.approx(0.1, abs=0.01) and plan.action[0, 1] == 4


@pytest.mark.parametrize(
    "choices", [1, (0.5,), (1.0, 1.0), {2: 3}, {0: (0.0, float("nan"))}, {"a": 3}, 5.0, "ab", [[0.0]]]
)
def test_choices_are_refused_when_they_are_none(make_planner, choices):
    with pytest.raises(ValueError, match="action_choices"):
        make_planner(action_choices=choices)


@pytest.mark.parametrize("choices", [np.int64(3), {np.int64(0): np.int32(3), 1: np.array([0.0, 1.0, 2.0])}])
def test_choices_are_numpy_numbers_too(make_planner, choices):
    assert make_planner(action_choices=choices).choices == {0: (0.0, 1.0, 2.0), 1: (0.0, 1.0, 2.0)}


def test_check_model_tries_the_values_of_a_planner(make_planner):
    table = torch.tensor([1.0, 2.0, 4.0])
    model = FunctionModel(lambda state, action: state, lambda state, action: table[action[:, 0].long()])
    check_model(model, torch.zeros(2, 1), planner=make_planner(action_dim=1, action_choices=3))
    strict = FunctionModel(lambda state, action: state, lambda state, action: table[action[:, 0]])
    with pytest.raises(ValueError, match=r"use action.long\(\)"):
        check_model(strict, torch.zeros(2, 1), planner=make_planner(action_dim=1, action_choices=3))
