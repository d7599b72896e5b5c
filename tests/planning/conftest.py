"""Small analytic models for the tests of planners."""

import pytest
import torch

from latentplan.planning import CEMPlanner, FunctionModel


def point_dynamics(state, action):
    """A point mass in the plane: state (rows, 4) is position and velocity, the action accelerates."""
    velocity = state[:, 2:] + 0.3 * action
    return torch.cat([state[:, :2] + 0.3 * velocity, velocity], dim=1)


def point_reward(state, action):
    return -state[:, :2].square().sum(dim=1) - 0.01 * action.square().sum(dim=1)


def point_value(state):
    return -3.0 * state[:, :2].square().sum(dim=1)


def point_policy(state, generator):
    mode = -state[:, :2] - state[:, 2:]
    if generator is None:
        return mode
    return mode + 0.2 * torch.randn(mode.shape, generator=generator, device=mode.device)


@pytest.fixture
def point():
    return FunctionModel(point_dynamics, point_reward, value=point_value, policy=point_policy)


@pytest.fixture
def states():
    return torch.randn(5, 4, generator=torch.Generator().manual_seed(3))


@pytest.fixture
def make_planner():
    """Makes a small planner of plain CEM: white noise, no kept elites, the mean is executed; as long warm as cold."""

    def make(**options):
        defaults = {"action_dim": 2, "horizon": 6, "num_samples": 64, "num_elites": 8, "num_iterations": 3}
        defaults |= {"num_policy_samples": 0, "init_std": 1.0, "min_std": 0.0}
        defaults |= {"final": "mean", "noise_beta": 0.0, "keep_elite_fraction": 0.0}
        defaults["warm_start_iterations"] = options.get("num_iterations", 3)
        return CEMPlanner(**defaults | options)

    return make


@pytest.fixture
def seeded():
    return lambda seed=0: torch.Generator().manual_seed(seed)
