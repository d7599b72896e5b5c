"""Close a corridor with a constraint: the plan of a point mass then takes the detour.

Prints y at the wall, the depth in the wall and the last distance to the goal; draws both paths (`corridor.png`).
"""

import sys

import torch
from matplotlib.figure import Figure
from torch import Tensor

from latentplan.planning import CEMPlanner, FunctionModel, ModelPredictiveController, at_every_state

GOAL = torch.tensor([1.0, 0.0])
WALL, CORRIDOR, DETOUR = 0.1, (-0.15, 0.15), (0.6, 0.9)  # half the thickness at x = 0; openings, as intervals of y


def dynamics(state: Tensor, action: Tensor) -> Tensor:
    """State (rows, 4): position x, y and velocity. Action (rows, 2) in [-1, 1]: acceleration."""
    velocity = 0.8 * state[:, 2:] + 0.1 * action
    return torch.cat([state[:, :2] + 0.2 * velocity, velocity], dim=1)


def depth_in_wall(state: Tensor, *openings: tuple[float, float]) -> Tensor:
    """Depth of a state (rows, 4) in the wall, (rows,); 0 outside the wall."""
    beside = [torch.maximum(low - state[:, 1], state[:, 1] - high) for low, high in openings]
    return torch.stack([WALL - state[:, 0].abs(), *beside]).amin(dim=0).clamp_min(0)


def travel(*openings: tuple[float, float]) -> Tensor:
    """Plans and executes a path to the goal; returns its states, (step, 4)."""
    model = FunctionModel(dynamics, reward=lambda state, action: -(state[:, :2] - GOAL).norm(dim=1))
    planner = CEMPlanner(action_dim=2, horizon=30, num_samples=400, noise_beta=2.0)  # smooth noise moves further
    wall = at_every_state(lambda state: depth_in_wall(state, *openings))
    controller = ModelPredictiveController(planner, model, constraints=[wall])
    states = torch.tensor([[-1.0, 0.0, 0.0, 0.0]])
    for _ in range(50):
        states = torch.cat([states, dynamics(states[-1:], controller.act(states[-1:]))])
    return states


def main(out: str = ".") -> None:
    """Travels with the corridor open and closed, and draws both paths."""
    torch.manual_seed(0)
    axes = Figure(layout="constrained").subplots()
    for name, openings in {"corridor open": (CORRIDOR, DETOUR), "corridor closed": (DETOUR,)}.items():
        states = travel(*openings)
        x, y = states[:, :2].T
        depth, distance = depth_in_wall(states, *openings).max(), (states[-1, :2] - GOAL).norm()
        print(f"{name}: crosses at y {y[x.abs().argmin()]:.2f}, depth {depth:.2f}, distance {distance:.2f}")
        axes.plot(x, y, ".-", label=name)
    axes.bar(0.0, [0.25, 0.45, 0.3], 2 * WALL, [-0.4, CORRIDOR[1], DETOUR[1]], color="gray", label="wall")
    axes.bar(0.0, 2 * CORRIDOR[1], 2 * WALL, CORRIDOR[0], color="moccasin", label="corridor")
    axes.set(xlabel="x", ylabel="y", title="From (-1, 0) to (1, 0)", aspect="equal")
    axes.legend()
    axes.figure.savefig(f"{out}/corridor.png")


if __name__ == "__main__":
    main(*sys.argv[1:2])  # folder of the picture; the current one unless given
