"""A search keeps the bounds, ignores numbers that are not finite, and refuses models and options that do not fit."""

import dataclasses

import pytest
import torch

from latentplan.config import PlannerConfig
from latentplan.planning import CEMPlanner, FunctionModel, ModelPredictiveController, SearchOptions
from latentplan.planning.search.sampling import Streams

RICH = {"num_policy_samples": 6, "keep_elite_fraction": 0.3, "noise_beta": 1.0, "tail": "policy"}


def test_candidates_are_scored_from_their_own_environments_state(make_planner, seeded):
    """Each environment's goal is its state: pairing a candidate with another's state would miss it."""
    model = FunctionModel(lambda state, action: state, lambda state, action: -(action - state).square().sum(dim=1))
    goals = torch.tensor([[0.8, -0.6], [-0.7, 0.1], [0.0, 0.9]])
    plan = make_planner(num_samples=256, num_iterations=8).plan(model, goals, generator=seeded())
    torch.testing.assert_close(plan.action, goals, atol=0.02, rtol=0)


@pytest.mark.parametrize("options", [{}, RICH, {"final": "best"}, RICH | {"final": "better"}, {"gradient_steps": 3}])
def test_actions_stay_within_asymmetric_bounds_in_model_and_plan(point, states, make_planner, seeded, options):
    low, high = torch.tensor([0.2, -3.0]), torch.tensor([0.7, -0.5])
    seen = []

    def dynamics(state, action):
        seen.append(action.detach())
        return point.dynamics(state, action)

    model = FunctionModel(dynamics, point.reward, value=point.value, policy=point.policy)
    planner = make_planner(action_low=low, action_high=high, **options)
    plan = planner.plan(model, states, generator=seeded())
    plan = planner.plan(model, states, plan.forget(torch.tensor([1, 0, 0, 0, 1]).bool()), generator=seeded())
    for actions in [torch.cat(seen), plan.mean, plan.actions]:
        assert (actions >= low).all() and (actions <= high).all()


def test_previous_plan_is_clamped_into_narrower_bounds(point, states, make_planner, seeded):
    wide, narrow = (make_planner(action_high=high, keep_elite_fraction=0.5) for high in (9.0, 0.1))
    plan = narrow.plan(point, states, wide.plan(point, states, generator=seeded()), generator=seeded())
    assert plan.elites.max() <= 0.1 and plan.actions.max() <= 0.1


def test_zero_tail_and_cold_start_are_in_the_middle_of_the_bounds(make_planner, seeded):
    model = FunctionModel(lambda state, action: state, lambda state, action: 0 * action.sum(dim=1))
    planner = make_planner(action_low=0.5, action_high=1.5, init_std=0.0, num_elites=64, smoothing=1.0)
    cold = planner.plan(model, torch.zeros(1, 4), generator=seeded())
    torch.testing.assert_close(cold.mean, torch.ones_like(cold.mean))
    warm = planner.plan(model, torch.zeros(1, 4), cold, generator=seeded())
    torch.testing.assert_close(warm.mean, torch.ones_like(cold.mean))


def test_init_std_is_in_action_units(make_planner, seeded):
    seen = []
    model = FunctionModel(
        lambda state, action: state, lambda state, action: (seen.append(action.clone()), action.sum(dim=1))[1]
    )
    planner = make_planner(action_low=-20.0, action_high=20.0, init_std=(2.0, 5.0), num_samples=4000, num_iterations=1)
    planner.plan(model, torch.zeros(1, 4), generator=seeded())
    torch.testing.assert_close(torch.cat(seen).std(dim=0), torch.tensor([2.0, 5.0]), rtol=0.05, atol=0)


def test_init_std_is_a_quarter_of_the_range_by_default(make_planner, seeded):
    planner = make_planner(init_std=None, action_low=(-1.0, 0.0), action_high=(3.0, 1.0), num_iterations=1)
    planner = dataclasses.replace(planner, smoothing=1e-9)
    model = FunctionModel(lambda state, action: state, lambda state, action: action.sum(dim=1))
    plan = planner.plan(model, torch.zeros(1, 4), generator=seeded())
    torch.testing.assert_close(plan.var, torch.tensor([1.0, 0.0625]).expand_as(plan.var))


def test_min_std_is_at_most_a_derived_init_std(make_planner, seeded):
    """With a floor of 0.05, every sample in a range of 0.02 would lie on the bounds."""
    model = FunctionModel(lambda state, action: state, lambda state, action: action.sum(dim=1))
    for init_std, expected in ((None, 0.005), (0.005, 0.05)):
        planner = make_planner(action_low=-0.01, action_high=0.01, init_std=init_std, min_std=0.05, smoothing=1e-9)
        std = planner.plan(model, torch.zeros(1, 4), generator=seeded()).info["std"]
        torch.testing.assert_close(std, torch.full_like(std, expected))


def test_min_std_floors_the_sampling_and_not_the_variance(point, states, make_planner, seeded):
    planner = make_planner(init_std=0.0, min_std=0.3, num_iterations=1, smoothing=1e-9)
    plan = planner.plan(point, states, generator=seeded())
    assert plan.var.max() < 1e-6
    torch.testing.assert_close(plan.info["std"], torch.full_like(plan.info["std"], 0.3))
    wide, narrow = (make_planner(init_std=0.0, min_std=std).plan(point, states, generator=seeded()) for std in (0.3, 0))
    assert (narrow.mean == 0).all() and (wide.mean != 0).any()


@pytest.mark.parametrize("broken", [float("nan"), float("inf")])
def test_nonfinite_candidates_are_counted_and_never_elites(states, make_planner, seeded, broken):
    """Every positive first action has a return that is not finite, so the plan must avoid it."""

    def reward(state, action):
        return torch.where(action[:, 0] > 0, broken, action[:, 0])

    model = FunctionModel(lambda state, action: state, reward)
    plan = make_planner(final="best").plan(model, states, generator=seeded())
    assert (plan.actions[..., 0] <= 0).all() and torch.isfinite(plan.mean).all()
    assert (plan.info["num_nonfinite"] > 0).all() and not plan.info["is_fallback"].any()


@pytest.mark.parametrize("options", [{}, {"warm_start": False}, {"num_policy_samples": 4}])
def test_tail_of_the_last_plan_is_executed_when_no_return_is_finite(point, states, make_planner, seeded, options):
    planner = make_planner(action_low=-0.4, **options)
    last = planner.plan(point, states, generator=seeded())
    broken = FunctionModel(
        point.dynamics, lambda state, action: torch.full_like(state[:, 0], float("nan")), policy=point.policy
    )
    plan = planner.plan(broken, states, last.forget(torch.tensor([1, 0, 0, 0, 0]).bool()), generator=seeded())
    assert plan.info["is_fallback"].all() and plan.expected_return.isnan().all()
    torch.testing.assert_close(plan.actions[1:, :-1], last.actions[1:, 1:])
    middle = torch.tensor(0.3)  # of the bounds -0.4 and 1
    torch.testing.assert_close(plan.actions[0], middle.expand(6, 2))
    torch.testing.assert_close(plan.actions[:, -1], middle.expand(5, 2))


def test_proposals_are_no_elites_when_they_are_nan(states, make_planner, seeded):
    model = FunctionModel(
        lambda state, action: state,
        lambda state, action: torch.nan_to_num(action[:, 0], nan=9.0),  # gives an action that is NaN a high reward
        policy=lambda state, generator: torch.full_like(state[:, :2], float("nan")),
    )
    plan = make_planner(num_policy_samples=8).plan(model, states, generator=seeded())
    assert torch.isfinite(plan.mean).all() and not plan.info["is_fallback"].any()


def test_use_continues_ends_only_the_candidate_that_is_done(make_planner, seeded):
    """Reward 1 for every step alive; action above 0 ends the episode."""

    def dynamics(state, action):
        return torch.maximum(state, (action[:, :1] > 0).float())

    model = FunctionModel(
        dynamics,
        lambda state, action: torch.ones(len(state)),
        continues=lambda state: 1.0 - state[:, 0],
        value=lambda state: torch.full((len(state),), 10.0),
    )
    plan = make_planner(use_continues=True, final="best", num_samples=512).plan(
        model, torch.zeros(2, 1), generator=seeded()
    )
    assert (plan.actions[..., 0] <= 0).all()
    torch.testing.assert_close(plan.expected_return, torch.full((2,), 16.0))


def test_use_continues_ignores_rewards_after_the_end(make_planner, seeded):
    """The episode ends in state 2; later states would have a high reward."""
    model = FunctionModel(
        lambda state, action: state + 1,
        lambda state, action: 1.0 + state[:, 0] + 0 * action[:, 0],
        continues=lambda state: (state[:, 0] != 2).float(),
        value=lambda state: 1000 + state[:, 0],
    )
    plan = make_planner(use_continues=True, discount=0.5).plan(model, torch.zeros(1, 1), generator=seeded())
    assert plan.expected_return.item() == pytest.approx(1.0 + 0.5 * 2.0)


def test_expected_return_is_discounted_reward_plus_discounted_value(make_planner, seeded):
    model = FunctionModel(
        lambda state, action: state + 1,
        lambda state, action: state[:, 0] + 0 * action[:, 0],
        value=lambda state: 100 * state[:, 0],
    )
    plan = make_planner(horizon=3, discount=0.5).plan(model, torch.zeros(1, 1), generator=seeded())
    assert plan.expected_return.item() == pytest.approx(0 + 0.5 * 1 + 0.25 * 2 + 0.125 * 300)


def test_plan_names_the_method_that_an_option_needs(point, states, make_planner):
    bare = FunctionModel(point.dynamics, point.reward)
    for options, method in [
        ({"terminal_value": True}, "value"),
        ({"num_policy_samples": 4}, "policy"),
        ({"use_continues": True}, "continues"),
    ]:
        with pytest.raises(ValueError, match=rf"{method}\(\)"):
            make_planner(**options).plan(bare, states)
    last = make_planner().plan(bare, states)
    with pytest.raises(ValueError, match=r"policy\(\)"):
        make_planner(tail="policy").plan(bare, states, last)


def test_terminal_value_is_used_by_default_when_the_model_has_a_value(point, states, make_planner, seeded):
    detected, asked, refused = (
        make_planner(terminal_value=choice).plan(point, states, generator=seeded()).mean
        for choice in (None, True, False)
    )
    assert torch.equal(detected, asked) and not torch.equal(detected, refused)


def test_shifted_last_plan_is_a_candidate(make_planner, seeded):
    """Only the shifted last plan has a reward, and no other candidate is sampled near it."""
    last_actions = torch.linspace(-0.9, 0.9, 12).reshape(1, 6, 2)
    wanted = torch.cat([last_actions[:, 1:], torch.zeros(1, 1, 2)], dim=1)

    def dynamics(state, action):
        return torch.cat([state[:, :1] + 1, state[:, 1:]], dim=1)

    def reward(state, action):
        target = wanted[0][state[:, 0].long()]
        return ((action - target).abs().amax(dim=1) < 1e-6).float()

    model = FunctionModel(dynamics, reward)
    model.policy = lambda state, generator: torch.full((len(state), 2), 0.99)
    planner = make_planner(init_std=1e-4, num_policy_samples=4, final="best", num_elites=1, num_iterations=3)
    previous = planner.plan(model, torch.zeros(1, 2), generator=seeded())
    previous = dataclasses.replace(previous, actions=last_actions, mean=last_actions)
    plan = planner.plan(model, torch.zeros(1, 2), previous, generator=seeded())
    torch.testing.assert_close(plan.actions, wanted)


def test_policy_mode_is_a_candidate(make_planner, seeded):
    """Only the mode of the policy has a reward, and its samples have none."""
    model = FunctionModel(
        lambda state, action: state,
        lambda state, action: (action - 0.625).abs().amax(dim=1).lt(1e-6).float(),
        policy=lambda state, generator: (
            torch.full((len(state), 2), 0.625) if generator is None else torch.zeros(len(state), 2)
        ),
    )
    plan = make_planner(num_policy_samples=2, final="best").plan(model, torch.zeros(3, 1), generator=seeded())
    torch.testing.assert_close(plan.actions, torch.full_like(plan.actions, 0.625))


def test_plan_tensors_carry_no_gradient_and_are_usable_as_targets(point, states, make_planner):
    weight = torch.ones(2, requires_grad=True)
    model = FunctionModel(point.dynamics, lambda state, action: point.reward(state, action * weight))
    plan = make_planner().plan(model, states)
    assert not plan.mean.requires_grad
    (plan.mean * weight).sum().backward()  # usable as a training target


def test_plan_is_float64_when_the_state_is_float64(point, states, make_planner):
    plan = make_planner().plan(point, states.double())
    assert plan.mean.dtype == plan.expected_return.dtype == torch.float64


def test_search_uses_fast_step_except_for_gradients(seeded):
    class Model:
        def __init__(self):
            self.calls = {"step": 0, "fast_step": 0}

        def step(self, state, action, name="step"):
            self.calls[name] += 1
            return state + action, -(state + action).square().sum(dim=1)

        def fast_step(self, state, action):
            return self.step(state, action, "fast_step")

    model, plans = Model(), []
    for steps in (0, 1):
        planner = CEMPlanner(action_dim=2, horizon=3, num_samples=16, num_elites=4, gradient_steps=steps)
        plans.append(planner.plan(model, torch.ones(1, 2), generator=seeded(0)))
        assert (model.calls["step"] > 0) == (steps > 0) and model.calls["fast_step"] > 0
    assert not torch.equal(plans[0].actions, plans[1].actions)


def test_controller_brings_a_point_mass_to_rest(point, make_planner, seeded):
    planner = make_planner(horizon=10, num_samples=256, num_elites=24, num_iterations=4, warm_start_iterations=3)
    controller = ModelPredictiveController(planner, point, generator=seeded())
    state = torch.tensor([[1.5, -1.0, 0.0, 0.5], [-1.0, 1.0, 0.5, 0.0]])
    for _ in range(40):
        state = point.dynamics(state, controller.act(state))
    assert state.abs().max() < 0.1


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"num_elites": 65}, "num_elites"),
        ({"num_policy_samples": 64}, "num_policy_samples"),
        ({"smoothing": 0.0}, "smoothing"),
        ({"discount": 1.1}, "discount"),
        ({"tail": "middle"}, "tail"),
        ({"final": "worst"}, "final"),
        ({"action_low": 1.0, "action_high": -1.0}, "action_low"),
        ({"action_low": [0.0, 0.0, 0.0]}, "action_low"),
        ({"action_high": float("inf")}, "action_high"),
        ({"init_std": -1.0}, "init_std"),
        ({"temperature": 0.0}, "temperature"),
        ({"warm_start_iterations": 0}, "warm_start_iterations"),
        ({"keep_elite_fraction": 1.5}, "keep_elite_fraction"),
        ({"min_std": float("nan")}, "min_std"),
        ({"min_std": 1e300}, "min_std"),
        ({"init_std": 1e300}, "init_std"),
        ({"noise_beta": 101}, "noise_beta"),
        ({"noise_beta": float("nan")}, "noise_beta"),
        ({"constraint_penalty": float("nan")}, "constraint_penalty"),
        ({"horizon": 2.5}, "horizon"),
        ({"num_samples": float("nan")}, "num_samples must be a whole number"),
        ({"num_iterations": float("inf")}, "num_iterations must be a whole number"),
        ({"num_policy_samples": -1}, "num_policy_samples"),
        ({"goal_horizon": 2.5}, "goal_horizon"),
        ({"gradient_steps": -1}, "gradient_steps"),
        ({"action_low": -1e39, "action_high": 1e39}, "action_low and action_high must lie in"),
        ({"action_low": -torch.ones(2, 3, 2), "action_high": torch.ones(3, 3, 2)}, "must fit each other"),
        ({"action_low": -torch.ones(3, 2), "action_high": torch.ones(4, 2)}, "must fit each other"),
    ],
)
def test_planner_names_a_bad_option(make_planner, options, name):
    with pytest.raises(ValueError, match=name):
        make_planner(**options)


def test_plan_names_wrong_shapes_from_the_model(point, states, make_planner):
    with pytest.raises(ValueError, match=r"step\(\)'s reward must have shape \(320,\), got \(320, 1\)"):
        make_planner().plan(FunctionModel(point.dynamics, lambda state, action: state[:, :1]), states)
    with pytest.raises(TypeError, match="tensor or a pytree"):
        make_planner().plan(point, [1.0, 2.0])
    with pytest.raises(TypeError, match="tensor or a pytree"):
        make_planner().plan(point, None, last_action=torch.zeros(1, 2))
    plan = make_planner().plan(point, states[:3])
    with pytest.raises(ValueError, match="last plan is for 3 environments and actions of 2, this search for 5"):
        make_planner().plan(point, states, plan)


def test_from_config_takes_every_option_of_a_configuration():
    config = PlannerConfig(horizon=3, num_samples=24, num_elites=6, final="best", surprise_limit=2.0)
    planner = CEMPlanner.from_config(config, 2, 0.9, action_low=(-1.0, 0.0))
    assert all(
        getattr(planner, option.name) == getattr(config, option.name) for option in dataclasses.fields(SearchOptions)
    )
    assert (planner.action_dim, planner.discount, planner.action_low) == (2, 0.9, (-1.0, 0.0))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"generator": 3}, "generator must be a torch.Generator or a list with one for each environment, got 3"),
        ({"generator": [1, 2, 3, 4, 5]}, r"a list with one for each environment, got \[1, 2, 3, 4, 5\]"),
        ({"bounds": 1.0}, r"bounds must be a pair \(lowest action, highest action\), got 1.0"),
        ({"bounds": (0.0, 0.5, 1.0)}, r"bounds must be a pair .*, got \(0.0, 0.5, 1.0\)"),
    ],
)
def test_plan_names_an_argument_of_a_wrong_kind(point, states, make_planner, arguments, message):
    with pytest.raises((TypeError, ValueError), match=message):
        make_planner().plan(point, states, **arguments)


@pytest.mark.parametrize("horizon", range(2, 12))
def test_coloured_noise_is_smoother_than_white_over_any_horizon(horizon):
    streams = Streams(torch.Generator().manual_seed(0), 1, torch.device("cpu"))
    noise, _ = streams.noise(20_000, horizon, 1, 2.0, 0.0, torch.float64)
    steps = noise[0, :, :, 0]
    assert (steps[:, 1:] * steps[:, :-1]).mean() > 0.25
    torch.testing.assert_close(steps.var(0), torch.ones(horizon, dtype=torch.float64), atol=0.05, rtol=0.0)
