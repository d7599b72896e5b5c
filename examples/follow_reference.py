"""Follow a reference that changes with time: the time is part of the state, so a plan sees what comes.

Prints the mean distance from the reference, of plans that know its future and of plans that think that it stays where
it is, and draws both paths (`reference.png`).
"""

import sys

import torch
from matplotlib.figure import Figure
from torch import Tensor

from latentplan.planning import CEMPlanner, FunctionModel, ModelPredictiveController

DT, STEPS = 0.1, 100


def reference(time: Tensor) -> Tensor:
    """The point to be at, (rows, 2), at times in s, (rows,): a figure of eight every 5 s."""
    phase = 2 * torch.pi * time / 5.0
    return torch.stack([phase.sin(), 0.5 * (2 * phase).sin()], dim=1)


def dynamics(state: Tensor, action: Tensor) -> Tensor:
    """State (rows, 5): position, velocity, time. Action (rows, 2) in [-1, 1]: acceleration, in 5 m/s²."""
    velocity = state[:, 2:4] + DT * 5.0 * action
    return torch.cat([state[:, :2] + DT * velocity, velocity, state[:, 4:] + DT], dim=1)


def frozen_dynamics(state: Tensor, action: Tensor) -> Tensor:
    """The same without the time, which stands still."""
    return torch.cat([dynamics(state, action)[:, :4], state[:, 4:]], dim=1)


def reward(state: Tensor, action: Tensor) -> Tensor:
    """Minus the squared distance from the reference, (rows,)."""
    return -(state[:, :2] - reference(state[:, 4])).square().sum(dim=1)


def main(out: str = ".") -> None:
    """Follows the reference with and without its future, prints the distances and draws the paths."""
    axes = Figure(layout="constrained").subplots()
    for name, steps in {"future known": dynamics, "future unknown": frozen_dynamics}.items():
        planner = CEMPlanner(action_dim=2, horizon=10, num_samples=200, num_iterations=3)
        generator = torch.Generator().manual_seed(0)
        controller = ModelPredictiveController(planner, FunctionModel(steps, reward), generator=generator)
        states = torch.zeros(1, 5)
        for _ in range(STEPS):
            states = torch.cat([states, dynamics(states[-1:], controller.act(states[-1:]))])
        points = reference(states[:, 4])
        print(f"{name}: mean distance {(states[:, :2] - points).norm(dim=1).mean():.3f} m")
        axes.plot(*states[:, :2].T, label=name)
    axes.plot(*points.T, "k--", label="reference")
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    axes.legend()
    axes.figure.savefig(f"{out}/reference.png")


if __name__ == "__main__":
    main(*sys.argv[1:2])  # folder of the picture; the current one unless given
