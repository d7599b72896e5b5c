"""Plan in dynamics of your own: a pendulum with a motor that is too weak to lift it in one swing.

Prints the cost per step of planning and of no torque, and draws the height of both pendulums (`own_dynamics.png`).
"""

import sys
from collections.abc import Callable

import torch
from matplotlib.figure import Figure
from torch import Tensor

from latentplan.planning import CEMPlanner, FunctionModel, ModelPredictiveController

DT, STEPS = 0.05, 120  # seconds per step, steps per episode


def dynamics(state: Tensor, action: Tensor) -> Tensor:
    """State (rows, 2): angle from upright in rad, velocity in rad/s. Action (rows, 1) in [-1, 1]: share of 2 N m."""
    angle, velocity = state.unbind(dim=1)
    velocity = velocity + DT * (15.0 * angle.sin() + 6.0 * action[:, 0])
    return torch.stack([angle + DT * velocity, velocity], dim=1)


def reward(state: Tensor, action: Tensor) -> Tensor:
    """Minus the cost of a step, (rows,): 0 at rest upright, -4 at rest hanging down."""
    angle, velocity = state.unbind(dim=1)
    return -((1 - angle.cos()).square() + 0.01 * velocity.square() + 0.001 * action[:, 0].square())


def play(act: Callable[[Tensor], Tensor]) -> tuple[float, list[float]]:
    """Mean cost of an episode that starts hanging down, and the height of the pendulum's tip at each step."""
    state, costs, heights = torch.tensor([[torch.pi, 0.0]]), [], []
    for _ in range(STEPS):
        action = act(state)
        costs.append(-float(reward(state, action)))
        heights.append(float(state[0, 0].cos()))
        state = dynamics(state, action)
    return sum(costs) / STEPS, heights


def main(out: str = ".") -> None:
    """Plays both pendulums, prints their costs and draws their heights."""
    planner = CEMPlanner(action_dim=1, horizon=25, num_samples=200, num_iterations=3, noise_beta=1.0)
    torch.manual_seed(0)
    controller = ModelPredictiveController(planner, FunctionModel(dynamics, reward))
    axes = Figure(layout="constrained").subplots()
    for name, act in {"planned": controller.act, "no torque": lambda state: torch.zeros(1, 1)}.items():
        cost, heights = play(act)
        print(f"{name}: cost per step {cost:.2f}, height at the end {heights[-1]:.2f}")
        axes.plot([DT * step for step in range(STEPS)], heights, label=name)
    axes.set(xlabel="time (s)", ylabel="height of the tip (1 is upright)", title="A pendulum planned in its equations")
    axes.legend()
    axes.figure.savefig(f"{out}/own_dynamics.png")


if __name__ == "__main__":
    main(*sys.argv[1:2])  # folder of the picture; the current one unless given
