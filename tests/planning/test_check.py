"""`check_model` names the problems of a model."""

import numpy as np
import pytest
import torch

from latentplan.planning import CEMPlanner, FunctionModel, check_model

STATE = torch.randn(3, 4, generator=torch.Generator().manual_seed(0))


def test_check_model_returns_the_optional_methods_of_a_good_model(point):
    assert check_model(point, STATE, 2) == ("value", "policy")


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"reward": lambda state, action: action[:, :1]}, r"reward must have shape \(4,\), got \(4, 1\)"),
        ({"reward": lambda state, action: (state[:, 0] > 0).long()}, "floating point"),
        ({"reward": lambda state, action: state[:, 0] / 0}, "NaN"),
        ({"reward": lambda state, action: 1.0}, "must be a tensor"),
        ({"dynamics": lambda state, action: state[:, :2]}, r"turns a state of \(4, 4\)"),
        ({"dynamics": lambda state, action: state.double()}, "float64"),
        ({"dynamics": lambda state, action: state * float("nan")}, "in the state"),
        ({"dynamics": lambda state, action: (state, state)}, "another structure"),
        ({"dynamics": lambda state, action: state + action.mean()}, "influence each other"),
        ({"value": lambda state: state[:, :1]}, r"value\(\) must have shape"),
        ({"policy": lambda state, generator: state}, r"policy\(\)'s mode must have shape"),
        ({"continues": lambda state: state[:, 0] * float("inf")}, r"continues\(\) is NaN"),
        ({"uncertainty": lambda state, action: state}, r"uncertainty\(\) must have shape"),
        ({"rollout": lambda state, actions: (actions[:, :, 0], state)}, r"rollout\(\) does not agree with step"),
        ({"fast_step": lambda state, action: (state, action[:, 0])}, r"fast_step\(\) does not agree with step"),
        ({"propose": lambda state, num, horizon, generators: state}, r"propose\(\) must have shape"),
        ({"rollout": lambda state, actions: (actions, state)}, r"rollout\(\)'s rewards must have shape"),
        ({"particles": lambda state, num: state}, r"particles\(\) must return 8 rows"),
        ({"reward": lambda state, action: -(state - state.amin(0)).square().sum(1)}, r"influence each other: step"),
        ({"dynamics": lambda state, action: state + state.mean(0)}, r"influence each other: step"),
        ({"value": lambda state: state.softmax(0).sum(1)}, r"influence each other: value"),
        ({"policy": lambda state, generator: (state - state.mean(0))[:, :2]}, r"influence each other: policy"),
        ({"particles": lambda state, num: state.repeat(num, 1)}, r"particles\(\)[^$]*not batch-major"),
        ({"dynamics": lambda state, action: state.add_(0.1)}, r"step\(\) changes its inputs"),
        ({"value": lambda state: state.mul_(2.0)[:, 0]}, r"value\(\) changes its inputs"),
        ({"dynamics": lambda state, action: state.reshape(7)}, r"step\(\) raises RuntimeError"),
        ({"value": lambda state: state.nothing}, r"value\(\) raises AttributeError"),
        ({"rollout": lambda state, actions: state}, r"rollout\(\) must return \(rewards, state\)"),
        ({"num_particles": 0}, "num_particles must be a whole number"),
        ({"num_particles": True}, "num_particles must be a whole number"),
        ({"value": lambda state: state[:, :1].squeeze()}, r"of one row alone, value\(\) must have shape \(1,\)"),
        (
            {"policy": lambda state, generator: torch.zeros(4, 2)},
            r"of one row alone, policy\(\)'s mode must have shape",
        ),
        ({"value": lambda state: state[:, 0] + 0 * state[1, 0]}, r"of one row alone, value\(\) raises IndexError"),
        ({"particles": lambda state, num: state.repeat_interleave(num, 0) * torch.nan}, r"particles\(\) returns NaN"),
        ({"particles": lambda state, num: (state.repeat_interleave(num, 0),)}, r"particles\(\) returns a state of ano"),
        (
            {"policy": lambda state, generator: (state if generator is None else state.mul_(2))[:, :2]},
            "policy.* changes",
        ),
    ],
)
def test_check_model_names_the_problem(point, change, complaint):
    for name, function in change.items():
        setattr(point, name, function)
    with pytest.raises(ValueError, match=complaint):
        check_model(point, STATE, 2)


def test_check_model_accepts_numpy_integers_as_num_particles(point):
    point.num_particles = np.int64(2)
    check_model(point, STATE, 2)


@pytest.mark.parametrize("state", [torch.zeros(5, 4), torch.zeros(1, 4)])
def test_check_model_finds_dependent_rows_when_given_rows_are_equal(point, state):
    point.value = lambda state: -(state - state.mean(0)).square().sum(1)
    with pytest.raises(ValueError, match=r"influence each other: value"):
        check_model(point, state, 2)


def test_check_model_names_all_problems_at_once(point):
    point.value = lambda state: state
    point.policy = lambda state, generator: state
    with pytest.raises(ValueError, match=r"value\(\)[^$]*policy\(\)"):
        check_model(point, STATE, 2)


def test_check_model_names_a_missing_step_and_a_state_that_is_no_tensor():
    with pytest.raises(ValueError, match="no step"):
        check_model(object(), STATE, 2)
    model = FunctionModel(lambda state, action: state, lambda state, action: action[:, 0])
    with pytest.raises(TypeError, match="tensor"):
        check_model(model, "state", 2)
    model.step = lambda state, action: state
    with pytest.raises(ValueError, match=r"\(next_state, reward\)"):
        check_model(model, STATE, 2)


def test_check_model_does_not_compare_steps_that_sample():
    def dynamics(state, action):
        return state + 0.1 * torch.randn_like(state)

    def rollout(state, actions):
        return torch.zeros(actions.shape[:2]), state + torch.randn_like(state)

    model = FunctionModel(dynamics, lambda state, action: torch.zeros(len(state)), rollout=rollout)
    model.fast_step = model.step
    assert check_model(model, STATE, 2) == ("rollout", "fast_step")


def test_check_model_finds_a_layer_that_mixes_the_batch():
    layer = torch.nn.BatchNorm1d(4)
    model = FunctionModel(lambda state, action: layer(state + action[:, :1]), lambda state, action: action[:, 0])
    layer.eval()
    check_model(model, STATE, 2)
    layer.train()
    with pytest.raises(ValueError, match="influence each other|Expected more than 1 value"):
        check_model(model, STATE, 2)


def test_check_takes_the_bounds_of_a_planner(states):
    """The throttle may not be negative, and a root of it would be NaN."""
    model = FunctionModel(
        lambda state, action: state, lambda state, action: action[:, 0].sqrt() + (action[:, 1] - 3).sqrt()
    )
    low = torch.tensor([[0.0, 3.0]] * 2)
    check_model(model, states, planner=CEMPlanner(action_dim=2, action_low=low, action_high=5.0))
    check_model(model, states, 2, action_low=(0.0, 3.0), action_high=(1.0, 4.0))
    with pytest.raises(ValueError, match="NaN"):
        check_model(model, states, 2)
    with pytest.raises(TypeError, match="needs action_dim or planner"):
        check_model(model, states)


def test_check_tries_all_discrete_values_whatever_the_bounds(states):
    seen = []
    model = FunctionModel(lambda state, action: state, lambda state, action: (seen.append(action), action[:, 0])[1])
    check_model(model, states, planner=CEMPlanner(action_dim=2, action_choices={0: (2.0, 5.0, 9.0)}))
    tried = torch.cat(seen)
    assert tried[:, 0].unique().tolist() == [2.0, 5.0, 9.0]
    assert (tried[:, 1].abs() <= 1.0).all() and len(tried[:, 1].unique()) > 3


@pytest.mark.parametrize(
    ("state", "hint"),
    [
        (torch.zeros(4), r"pass state\[None\] if it is one environment"),
        (torch.zeros(3, 4, 2), r"state.flatten\(0, 1\)"),
    ],
)
def test_check_explains_what_the_rows_of_a_state_are(state, hint):
    model = FunctionModel(lambda state, action: state, lambda state, action: state[:, 0, 0, 0] * 0)
    with pytest.raises(ValueError, match=hint):
        check_model(model, state, 1)


def test_check_explains_five_tuples_and_integer_actions(states):
    gym = type("Gym", (), {"step": lambda self, state, action: (state, action[:, 0], False, False, {})})()
    with pytest.raises(ValueError, match="got a tuple of 5; of a gymnasium step, return the first two"):
        check_model(gym, states, 2)
    table = torch.zeros(3)
    indexed = FunctionModel(lambda state, action: state, lambda state, action: table[action[:, 0]])
    with pytest.raises(ValueError, match="actions are floating point"):
        check_model(indexed, states, 2)
