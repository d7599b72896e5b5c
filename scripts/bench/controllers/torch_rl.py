"""CEM and MPPI of TorchRL, with the task as a model-based environment; each search starts cold."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDict  # type: ignore[import-not-found]
from tensordict.nn import TensorDictModule  # type: ignore[import-not-found]
from torch import Tensor, nn
from torchrl.data import Bounded, Composite, Unbounded  # type: ignore[import-not-found]
from torchrl.envs.model_based import ModelBasedEnvBase  # type: ignore[import-not-found]
from torchrl.modules import CEMPlanner, MPPIPlanner  # type: ignore[import-not-found]

from bench.controllers.serve import Entry, serve
from bench.controllers.task import Act, Task

TEMPERATURES = tuple({"temperature": value} for value in (0.3, 3.0, 30.0))  # the library multiplies by it


class TaskEnv(ModelBasedEnvBase):  # type: ignore[misc]
    """The task as an environment whose observation is the state."""

    def __init__(self, task: Task, size: int) -> None:
        step = task.stepper()

        def advance(seen: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
            following, cost = step(seen.flatten(0, -2), action.flatten(0, -2))
            return following.view_as(seen), -cost.view(*seen.shape[:-1], 1)

        super().__init__(TensorDictModule(advance, in_keys=["seen", "action"], out_keys=["seen", "reward"]))
        for name in ("state_spec", "observation_spec"):
            setattr(self, name, Composite({"seen": Unbounded((size,))}))
        self.action_spec = Bounded(-1.0, 1.0, (task.problem.action_dim,))
        self.reward_spec = Unbounded((1,))

    def _reset(self, tensordict: TensorDict, **_: Any) -> TensorDict:
        return tensordict


class Return(nn.Module):
    """Writes the summed reward of each candidate, below that of the best, as its advantage."""

    def forward(self, tensordict: TensorDict) -> TensorDict:
        """The same tensordict with `advantage`."""
        reward = tensordict["next", "reward"]  # (1, candidate, step, 1)
        total = reward.sum(dim=-2, keepdim=True)
        # The planner takes the exponential of the advantage, which is 0 for all candidates if all are very negative.
        return tensordict.set("advantage", (total - total.max()).expand_as(reward).contiguous())


def make_with(kind: Any) -> Callable[[Task, Sequence[int]], Act]:
    """A function that makes a controller of a planner."""

    def make(task: Task, seeds: Sequence[int]) -> Act:
        env = TaskEnv(task, len(task.problem.start(seeds)[0]))
        own = {"advantage_module": Return()} if kind is MPPIPlanner else {}
        planner = kind(
            env,
            planning_horizon=task.problem.horizon,
            optim_steps=task.iterations,
            num_candidates=task.samples,
            top_k=task.num_elites,
            **own,
            **task.settings,
        )
        flags = {name: torch.zeros(1, 1, dtype=torch.bool) for name in ("done", "terminated")}

        def act(state: Tensor) -> Tensor:
            unit: Tensor = planner(TensorDict({"seen": state, **flags}, batch_size=[1]))["action"]
            return unit

        return task.unscaled(act)

    return make


if __name__ == "__main__":
    serve({"CEM": Entry(make_with(CEMPlanner)), "MPPI": Entry(make_with(MPPIPlanner), choices=TEMPERATURES)})
