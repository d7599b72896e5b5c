"""The search that every planner is timed on, in one untrained RSSM."""

from __future__ import annotations

import json
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor, nn

from latentplan.config import ModelConfig, from_dict
from latentplan.models import State, WorldModel
from latentplan.models.fast import accelerate

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}
ELITE_SHARE = 0.1
REWARD_SCALE = 0.1  # an untrained reward head predicts zero everywhere, so all candidates would be equal


@dataclass(frozen=True)
class Problem:
    """One search: its sizes and its model, the same for every planner.

    Attributes:
        samples: Candidates per iteration.
        horizon: Model steps of each candidate.
        iterations: Refits.
        action_dim: Numbers in an action, each in [-1, 1].
        model: Settings of the world model, as plain values.
        device: `cpu` or `cuda`.
        threads: CPU threads.
        seed: Seed of the weights and of the start.
    """

    samples: int
    horizon: int
    iterations: int
    action_dim: int
    model: dict[str, Any]
    device: str
    threads: int
    seed: int = 0

    @property
    def num_elites(self) -> int:
        """A tenth of the candidates, at least two."""
        return count_elites(self.samples)

    @property
    def model_config(self) -> ModelConfig:
        """The settings of the world model."""
        return from_dict({"model": self.model}).model

    def to_json(self) -> str:
        """One line that `from_json` reads."""
        return json.dumps(asdict(self))

    @staticmethod
    def from_json(text: str) -> Problem:
        """The problem that `to_json` wrote."""
        return Problem(**json.loads(text))


def count_elites(samples: int) -> int:
    """The number of elites that planners of other libraries take: a tenth of the candidates, at least two."""
    return max(2, round(ELITE_SHARE * samples))


class FullPrecisionModel(WorldModel):
    """The world model with its trunk in float32."""

    def trunk_precision(self, *, cache: bool = True) -> AbstractContextManager[None]:
        """A context without autocast."""
        return torch.autocast(self.device.type, enabled=False)


def build_model(problem: Problem, dtype: str) -> WorldModel:
    """The seeded world model of a problem, its trunk computed in `float32` or `bfloat16`; the weights are the same."""
    kind = {"float32": FullPrecisionModel, "bfloat16": WorldModel}[dtype]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(problem.seed)
        model = kind(problem.model_config, problem.action_dim)
        nn.init.normal_(model.reward_head.mlp.output.weight, std=REWARD_SCALE)
    accelerate(model.to(problem.device).eval())
    if dtype == "bfloat16" and model.device.type == "cpu":
        model.backend.trunk_dtype = torch.bfloat16  # also on a processor where float32 is faster
    return model


def start_state(problem: Problem, batch: int = 1) -> State:
    """The state from which every search starts, (batch, ...)."""
    config, generator = problem.model_config, torch.Generator().manual_seed(problem.seed)
    deter = torch.rand(batch, config.deter_dim, generator=generator) * 2.0 - 1.0  # the range of a GRU's state
    stoch = torch.randn(batch, config.latent_dim, generator=generator)
    return State(deter.to(problem.device), stoch.to(problem.device))


def summed_rewards(model: WorldModel, start: State, actions: Tensor) -> Tensor:
    """Reward of each action sequence (sample, horizon, action) from one start (1, ...), step by step: (sample,)."""
    state = State(*(part.expand(len(actions), -1) for part in start))
    total = torch.zeros(len(actions), device=actions.device)
    for action in actions.unbind(1):
        state, reward = model.step(state, action)
        total = total + reward
    return total


def as_state(model: WorldModel, features: Tensor) -> State:
    """The state in features (rows, deter + latent)."""
    return State(*features.split([model.config.deter_dim, model.config.latent_dim], -1))


def next_features(model: WorldModel, features: Tensor, action: Tensor) -> Tensor:
    """The features (rows, deter + latent) after an action, for planners with vectors as states."""
    with model.trunk_precision():
        deter = model.dynamics.advance(as_state(model, features), action)
        return torch.cat([deter, model.dynamics.prior(deter).mean], -1)


def rewards_at(model: WorldModel, features: Tensor) -> Tensor:
    """Reward (...) that arrives with features (..., deter + latent)."""
    with model.trunk_precision():
        return model.reward_head.mean(model.reward_head(features))
