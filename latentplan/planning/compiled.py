"""A model whose imagined rollouts torch compiles."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from torch import Tensor

from latentplan.planning.model import Model, State, supports, take_step


def compile_rollout(model: Model, **options: Any) -> Model:
    """The same model with a `rollout` that `torch.compile` makes one program of, all steps of a plan at once.

    Pays where a step is many small operations, such as true equations or a small network: between two of them Python
    costs more than the arithmetic. The first search of each size waits for the compiler, seconds to a minute; later
    ones give the same numbers, to rounding. What needs the states on the way (most objectives and constraints, and
    `use_continues`) still steps through `model.step`.

    Args:
        model: Any model; its own `rollout` is compiled where it has one, else a loop over its `step`.
        options: Of `torch.compile`; on a GPU, `mode="reduce-overhead"` records CUDA graphs.

    Returns:
        A model with everything that `model` has. It can be pickled where `model` can, and is compiled anew there.

    Raises:
        torch._dynamo.exc.BackendCompilerFailed: While planning, where torch finds no C++ compiler.
    """
    return _Compiled(model, options)


class _Compiled:
    def __init__(self, model: Model, options: dict[str, Any]) -> None:
        self._model, self._options = model, options
        own = model.rollout if supports(model, "rollout") else partial(_step_through, model)  # type: ignore[attr-defined]
        self.rollout = torch.compile(own, **options)

    def __getattr__(self, name: str) -> Any:  # asked for what is not here: an absent attribute stays absent
        return getattr(self._model, name)

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(compile_rollout, **self._options), (self._model,)

    def step(self, state: State, action: Tensor) -> tuple[State, Tensor]:
        return self._model.step(state, action)


def _step_through(model: Model, state: State, actions: Tensor) -> tuple[Tensor, State]:
    rewards = []
    for step in range(actions.shape[1]):
        state, reward = take_step(model, state, actions[:, step])
        rewards.append(reward)
    return torch.stack(rewards, dim=1), state
