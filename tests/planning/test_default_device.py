"""Plans do not depend on torch's default device: they are made on the device of the state."""

import contextlib

import numpy as np
import pytest
import torch

from latentplan.planning import (
    CEMPlanner,
    CEMTrajectoryOptimizer,
    ModelPredictiveController,
    Plan,
    check_model,
    rate_limit,
)

# A tensor on the device `meta` has no numbers, so that a computation with it fails or differs.
OTHER_DEVICE = torch.device("meta")
OPTIONS = {
    "coloured noise": {"noise_beta": 1.0, "white_noise_share": 0.5},
    "splines": {"num_knots": 3, "action_spline": "cubic"},
    "held knots": {"num_knots": 3, "action_spline": "zero"},
    "policy and value": {"num_policy_samples": 4, "terminal_value": True, "tail": "policy", "final": "better"},
    "gradient": {"gradient_steps": 2},
    "discrete": {"action_choices": {1: [-1.0, 0.0, 0.5]}},
    "no time": {"num_policy_samples": 4, "deadline_ms": 1e-6},
}


def control(point, states, options, default):
    """Actions of a controller that starts around a trajectory, is given a new limit, and loses one environment."""
    with default:
        planner = CEMPlanner(action_dim=2, horizon=6, num_samples=32, num_elites=6, num_iterations=2, **options)
        controller = ModelPredictiveController(planner, point, generator=torch.Generator().manual_seed(0))
        controller.plan = Plan.around(np.zeros((len(states), 6, 2), np.float32))
        actions = [controller.act(states)]
        controller.set_objective(None, constraints=[rate_limit(per_step=[0.3, 0.4])])
        actions.append(controller.act(states, last_action=[[0.1, 0.0]] * len(states)))
        is_over = torch.tensor([True] + [False] * (len(states) - 1), device="cpu")
        controller.reset(is_over)
        actions += [controller.act(states), controller.act_where(states, is_over)]
        assert controller.latency["p50_ms"] > 0.0
    return torch.cat(actions)


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_controllers_give_the_same_actions(point, states, options):
    expected = control(point, states, options, contextlib.nullcontext())
    assert torch.equal(control(point, states, options, OTHER_DEVICE), expected)


def test_models_are_checked(point, states):
    with OTHER_DEVICE:
        assert "policy" in check_model(point, states, action_dim=2)


def test_the_optimizer_of_arrays_gives_the_same_plan():
    def search():
        optimizer = CEMTrajectoryOptimizer(horizon=4, action_dim=2, action_low=[-1.0, -2.0], action_high=1.0)
        return optimizer.plan(np.zeros(2), lambda state, sequence: -float((sequence**2).sum()), np.full((4, 2), 0.5))

    expected = search()
    with OTHER_DEVICE:
        found = search()
    assert all(np.array_equal(one, other) for one, other in zip(found, expected, strict=True))
