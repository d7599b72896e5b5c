"""CEMPlanner of TorchRL, with the model as a model-based environment."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict  # type: ignore[import-not-found]
from tensordict.nn import TensorDictModule  # type: ignore[import-not-found]
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded  # type: ignore[import-not-found]
from torchrl.envs.model_based import ModelBasedEnvBase  # type: ignore[import-not-found]
from torchrl.modules import CEMPlanner  # type: ignore[import-not-found]

from bench.peers.problem import Problem, start_state
from bench.peers.serve import Search, serve
from latentplan.models import State, WorldModel


class RssmEnv(ModelBasedEnvBase):  # type: ignore[misc]
    """The world model as an environment with the model's state as observation."""

    def __init__(self, model: WorldModel, problem: Problem) -> None:
        def step(deter: Tensor, stoch: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            state, reward = model.step(State(deter, stoch), action)
            return state.deter, state.stoch, reward.unsqueeze(-1)

        module = TensorDictModule(step, in_keys=["deter", "stoch", "action"], out_keys=["deter", "stoch", "reward"])
        super().__init__(module, device=problem.device)
        sizes = {"deter": model.config.deter_dim, "stoch": model.config.latent_dim}
        for name in ("state_spec", "observation_spec"):
            parts = {part: Unbounded((size,), device=problem.device) for part, size in sizes.items()}
            setattr(self, name, Composite(parts, device=problem.device))
        self.action_spec = Bounded(-1.0, 1.0, (problem.action_dim,), device=problem.device)
        self.reward_spec = Unbounded((1,), device=problem.device)

    def _reset(self, tensordict: TensorDict, **_: Any) -> TensorDict:
        return tensordict


def make_search(problem: Problem, model: WorldModel) -> Search:
    """A cold search from the problem's start."""
    planner = CEMPlanner(
        RssmEnv(model, problem),
        planning_horizon=problem.horizon,
        optim_steps=problem.iterations,
        num_candidates=problem.samples,
        top_k=problem.num_elites,
    )
    start = start_state(problem)
    flags = {name: torch.zeros(1, 1, dtype=torch.bool, device=problem.device) for name in ("done", "terminated")}
    seen = TensorDict({**start._asdict(), **flags}, batch_size=[1], device=problem.device)

    def search() -> Tensor:
        action: Tensor = planner(seen.clone())["action"][0]
        return action

    return search


if __name__ == "__main__":
    serve(make_search)
