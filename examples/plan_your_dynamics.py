"""Plan in dynamics of your own: a pendulum too weak to swing up in one go.

Prints the closed-loop cost per step of planning and of doing nothing, and draws both angles into `own_dynamics.png`.
"""

import argparse
from pathlib import Path

import matplotlib
import torch

from latentplan.planning import CEMPlanner, FunctionModel, ModelPredictiveController

matplotlib.use("Agg")
from matplotlib import pyplot  # noqa: E402

DT, STEPS = 0.05, 120  # seconds per step, steps per episode


def dynamics(state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    """State (rows, 2): angle from upright in rad, velocity in rad/s. Action (rows, 1) in [-1, 1] is 2 N m."""
    angle, velocity = state.unbind(dim=1)
    velocity = velocity + DT * (15.0 * angle.sin() + 3.0 * 2.0 * action[:, 0])
    return torch.stack([angle + DT * velocity, velocity], dim=1)


def cost(state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    """Cost (rows,): 0 when upright and at rest, 4 when hanging."""
    angle, velocity = state.unbind(dim=1)
    return (1 - angle.cos()).square() + 0.01 * velocity.square() + 0.001 * action[:, 0].square()


def control(controller: ModelPredictiveController | None) -> tuple[float, list[float]]:
    """Mean cost of an episode that starts hanging, and its angles; no controller applies no torque."""
    state, total, angles = torch.tensor([[torch.pi, 0.0]]), 0.0, []
    for _ in range(STEPS):
        action = torch.zeros(1, 1) if controller is None else controller.act(state)
        total += float(cost(state, action))
        angles.append(float(state[0, 0]))
        state = dynamics(state, action)
    return total / STEPS, angles


def main(out: Path) -> None:
    """Swing the pendulum up and draw what happened."""
    model = FunctionModel(dynamics, reward=lambda state, action: -cost(state, action))
    planner = CEMPlanner(action_dim=1, horizon=25, num_samples=200, num_iterations=3, noise_beta=1.0)
    controller = ModelPredictiveController(planner, model, generator=torch.Generator().manual_seed(0))
    for name, player in {"planned": controller, "no torque": None}.items():
        mean_cost, angles = control(player)
        print(f"{name}: cost per step {mean_cost:.2f}, last angle {angles[-1]:.2f} rad")
        pyplot.plot([DT * step for step in range(STEPS)], angles, label=name)
    pyplot.gca().set(xlabel="time (s)", ylabel="angle from upright (rad)", title="Pendulum, planned in its equations")
    pyplot.legend()
    pyplot.savefig(out / "own_dynamics.png", dpi=100)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("."), help="folder of the picture (the current one)")
    main(parser.parse_args().out)
