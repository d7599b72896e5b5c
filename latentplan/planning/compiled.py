"""A model with a rollout that `torch.compile` compiles."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from torch import Tensor

from latentplan.planning.model import Model, State, supports, take_step


def compile_rollout(model: Model, **options: Any) -> Model:
    """Returns the same model with a `rollout` that is compiled as one program over all steps of a plan.

    Compiling saves time if a step consists of many small operations (equations of motion, a small network), because
    Python's overhead per operation is then larger than the arithmetic. The first search of each size waits seconds to a
    minute for the compiler. Results are the same up to rounding. Objectives and constraints that read the states of a
    rollout, and `use_continues`, still call `model.step`.

    Args:
        model: Any model; its own `rollout` is compiled if it has one, else a loop over its `step`.
        options: Options of `torch.compile`; on a GPU, `mode="reduce-overhead"` records CUDA graphs.

    Returns:
        A model with all attributes of `model`. It can be pickled if `model` can, and compiles again after unpickling.

    Raises:
        torch._dynamo.exc.BackendCompilerFailed: While planning, if torch finds no C++ compiler.
    """
    return _CompiledModel(model, options)


class _CompiledModel:
    """A model around another one, with a compiled rollout."""

    def __init__(self, model: Model, options: dict[str, Any]) -> None:
        self._model, self._options = model, options
        rollout = model.rollout if supports(model, "rollout") else partial(_step_through, model)  # type: ignore[attr-defined]
        self.rollout = torch.compile(rollout, **options)

    def __getattr__(self, name: str) -> Any:  # called for attributes that this class lacks
        return getattr(self._model, name)

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(compile_rollout, **self._options), (self._model,)

    def step(self, state: State, action: Tensor) -> tuple[State, Tensor]:
        return self._model.step(state, action)


def _step_through(model: Model, state: State, actions: Tensor) -> tuple[Tensor, State]:
    """Returns rewards (rows, horizon) and the last state of steps along actions (rows, horizon, action)."""
    rewards = []
    for step in range(actions.shape[1]):
        state, reward = take_step(model, state, actions[:, step])
        rewards.append(reward)
    return torch.stack(rewards, dim=1), state
