"""MPPI and KMPPI of pytorch_mppi, with the cost as one more number of the state."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from pytorch_mppi import KMPPI, MPPI  # type: ignore[import-not-found]
from pytorch_mppi.mppi import RBFKernel  # type: ignore[import-not-found]
from torch import Tensor

from bench.controllers.serve import Entry, serve
from bench.controllers.task import Act, Task

CHOICES = tuple(
    {"lambda_": temperature, "std": std}
    for temperature, std in ((0.3, 0.5), (0.3, 1.0), (0.03, 0.5), (3.0, 0.5), (30.0, 0.5))
)


def make_with(kind: Any, **own: Any) -> Callable[[Task, Sequence[int]], Act]:
    """A function that makes a controller of a class of the library; each iteration is one command."""

    def make(task: Task, seeds: Sequence[int]) -> Act:
        step, ones = task.stepper(), torch.ones(task.problem.action_dim)
        size = len(task.problem.start(seeds)[0])

        def dynamics(rows: Tensor, unit: Tensor) -> Tensor:
            following, cost = step(rows[:, :size], unit)
            return torch.cat([following, cost[:, None]], dim=1)

        controller = kind(
            dynamics,
            lambda rows, unit: rows[:, size],
            nx=size + 1,
            noise_sigma=task.settings["std"] ** 2 * torch.eye(len(ones)),
            lambda_=task.settings["lambda_"],
            num_samples=task.samples,
            horizon=task.problem.horizon,
            u_min=-ones,
            u_max=ones,
            U_init=torch.zeros(task.problem.horizon, len(ones)),
            **own,
        )

        def act(state: Tensor) -> Tensor:
            start = torch.cat([state[0], torch.zeros(1)])
            for command in range(task.iterations):
                unit: Tensor = controller.command(start, shift_nominal_trajectory=command == 0)
            return unit[None]

        return task.unscaled(act)

    return make


if __name__ == "__main__":
    serve(
        {
            "MPPI": Entry(make_with(MPPI), choices=CHOICES),
            "KMPPI": Entry(make_with(KMPPI, kernel=RBFKernel(sigma=2)), choices=CHOICES),
        }
    )
