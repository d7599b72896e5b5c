"""iCEM of pytorch_icem, with the cost as one more number of the state."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import torch
from pytorch_icem import iCEM  # type: ignore[import-not-found]
from torch import Tensor

from bench.controllers.serve import Entry, serve
from bench.controllers.task import Act, Task

CHOICES = tuple({"std": std, "noise_beta": beta} for std, beta in product((0.5, 1.0), (1.0, 2.0, 3.0)))


def make(task: Task, seeds: Sequence[int]) -> Act:
    """A controller of one environment."""
    step, size = task.stepper(), len(task.problem.start(seeds)[0])
    action_dim = task.problem.action_dim

    def dynamics(rows: Tensor, unit: Tensor) -> Tensor:
        following, cost = step(rows[:, :size], unit)
        return torch.cat([following, cost[:, None]], dim=1)

    controller = iCEM(
        dynamics,
        lambda rows, units: rows[:, :, size].sum(dim=1),
        nx=size + 1,
        nu=1,
        sigma=task.settings["std"],
        noise_beta=task.settings["noise_beta"],
        num_samples=task.samples,
        num_elites=task.num_elites,
        horizon=task.problem.horizon,
        warmup_iters=task.iterations,
        online_iters=task.iterations,
    )
    # The constructor accepts sigma for one-dimensional actions only; the search broadcasts over any number.
    controller.nu, controller.sigma = action_dim, torch.full((action_dim,), task.settings["std"])
    controller.reset()

    def act(state: Tensor) -> Tensor:
        unit: Tensor = controller.command(torch.cat([state[0], torch.zeros(1)]))
        return unit[None]

    return task.unscaled(act)


if __name__ == "__main__":
    serve({"iCEM": Entry(make, choices=CHOICES)})
