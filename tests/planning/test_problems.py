"""Problems with a known solution: linear-quadratic control, and a pendulum that must be swung up."""

import math

import pytest
import torch

from latentplan.planning import FunctionModel, ModelPredictiveController, icem_planner
from latentplan.planning.search.scorer import Scorer


def linear_problem(num_states, generator):
    """A random controllable system: dynamics A, B and costs Q, R, in double."""
    matrix = torch.randn(num_states, num_states, generator=generator, dtype=torch.float64)
    dynamics = 0.95 * matrix / torch.linalg.eigvals(matrix).abs().max()
    control = torch.randn(num_states, 2, generator=generator, dtype=torch.float64) / math.sqrt(num_states)
    return dynamics, control, torch.eye(num_states).double(), 0.1 * torch.eye(2).double()


def riccati(dynamics, control, state_cost, action_cost, horizon):
    """Matrix of the cost of `horizon` steps and of the last state, by Riccati's recursion."""
    cost = state_cost
    for _ in range(horizon):
        gain = torch.linalg.solve(action_cost + control.T @ cost @ control, control.T @ cost @ dynamics)
        cost = state_cost + dynamics.T @ cost @ (dynamics - control @ gain)
    return cost


@pytest.mark.parametrize("num_states", [2, 4, 8, 12])
def test_icem_reaches_the_riccati_return_within_two_percent(num_states):
    generator = torch.Generator().manual_seed(num_states)
    dynamics, control, state_cost, action_cost = linear_problem(num_states, generator)
    horizon = 8

    def quadratic(vectors, matrix):
        return torch.einsum("ri,ij,rj->r", vectors, matrix, vectors)

    model = FunctionModel(
        lambda state, action: state @ dynamics.T + action @ control.T,
        lambda state, action: -quadratic(state, state_cost) - quadratic(action, action_cost),
        value=lambda state: -quadratic(state, state_cost),
    )
    state = torch.randn(3, num_states, generator=generator, dtype=torch.float64)
    optimum = -quadratic(state, riccati(dynamics, control, state_cost, action_cost, horizon))
    planner = icem_planner(
        action_dim=2,
        horizon=horizon,
        num_samples=300,
        num_elites=30,
        num_iterations=25,
        noise_beta=0.0,
        action_low=-5.0,
        action_high=5.0,
    )
    plan = planner.plan(model, state, generator=torch.Generator().manual_seed(0))
    discounts = torch.ones(horizon + 1, dtype=torch.float64)
    scorer = Scorer.build(model, None, (), discounts, terminal_value=True, use_continues=False, penalty=None)
    achieved = scorer.score(scorer.start_rows(state, 1), plan.actions[:, None]).returns[:, 0]
    assert (achieved >= 1.02 * optimum).all() and (achieved <= optimum + 1e-9).all()


def test_icem_swings_up_a_pendulum_with_its_true_dynamics():
    """The torque is too small to lift the pendulum directly, so it must swing back and forth."""

    def dynamics(state, action):
        angle, speed = state[:, 0], state[:, 1]
        speed = (speed + 0.05 * (15.0 * torch.sin(angle) + 3.0 * action[:, 0])).clamp(-8.0, 8.0)
        return torch.stack([angle + 0.05 * speed, speed], dim=1)

    def reward(state, action):
        angle = torch.atan2(torch.sin(state[:, 0]), torch.cos(state[:, 0]))
        return -angle.square() - 0.1 * state[:, 1].square() - 0.001 * action[:, 0].square()

    planner = icem_planner(
        action_dim=1,
        horizon=25,
        num_samples=200,
        num_elites=20,
        num_iterations=3,
        action_low=-2.0,
        action_high=2.0,
    )
    controller = ModelPredictiveController(
        planner, FunctionModel(dynamics, reward), generator=torch.Generator().manual_seed(0)
    )
    state = torch.tensor([[math.pi, 0.0], [math.pi - 1.0, 1.0]])
    for _ in range(120):
        state = dynamics(state, controller.act(state))
    assert torch.cos(state[:, 0]).min() > 0.95 and state[:, 1].abs().max() < 1.0


def test_elites_are_the_same_for_bfloat16_and_float32_trunks_at_a_value_of_1000():
    """Only products of the trunk are in bfloat16, in which neighbouring numbers near 1000 differ by 4."""
    generator = torch.Generator().manual_seed(0)
    hidden, output = torch.randn(16, 64, generator=generator) / 4, torch.randn(64, 16, generator=generator) / 8
    heads = torch.randn(16, 2, generator=generator)

    class Latent:
        def __init__(self, trunk):
            self.trunk = trunk

        def step(self, state, action):
            inputs = torch.cat([state[:, :10], action], dim=1).to(self.trunk)
            change = torch.tanh(inputs @ hidden.to(self.trunk)) @ output.to(self.trunk)
            state = torch.tanh(state + change.float())
            return state, (state @ heads[:, 0]).to(self.trunk)

        def value(self, state):
            return 1000.0 + state @ heads[:, 1]

    state = torch.randn(8, 16, generator=generator)
    planner = icem_planner(
        action_dim=6, horizon=5, num_samples=512, num_elites=64, num_iterations=1, keep_elite_fraction=1.0
    )
    plans = [
        planner.plan(Latent(trunk), state, generator=torch.Generator().manual_seed(1))
        for trunk in (torch.float32, torch.bfloat16)
    ]
    assert plans[1].expected_return.dtype == torch.float32
    same = (plans[0].elites[:, :, None] == plans[1].elites[:, None]).all(dim=-1).all(dim=-1).any(dim=2)
    assert same.float().mean() >= 0.95
