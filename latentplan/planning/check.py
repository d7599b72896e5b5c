"""Finds what is wrong with a model before the first plan."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves, tree_map, tree_structure

from latentplan.planning.model import Model, State, action_dtype, count_rows, repeat_rows, state_device, supports

_ROWS, _HORIZON = 4, 3
_OPTIONAL = ("value", "policy", "continues", "uncertainty", "rollout", "fast_step", "propose", "particles")


@torch.no_grad()
def check_model(model: Model, state: State, action_dim: int, *, tolerance: float = 1e-3) -> tuple[str, ...]:
    """Tries every method of a model and names what is wrong.

    Args:
        model: The model.
        state: A typical state, any number of rows.
        action_dim: Numbers in an action; those tried lie in [-1, 1].
        tolerance: Relative difference allowed where two ways to compute a thing must agree.

    Returns:
        The optional methods that the model has.

    Raises:
        TypeError: The state is not a tensor or a pytree of tensors.
        ValueError: Lists every problem found, one per line: shapes, dtypes, NaN, rows that influence each other, a
            rollout that does not agree with steps.
    """
    count_rows(state)
    rows = repeat_rows(tree_map(lambda leaf: leaf[:1], state), _ROWS)
    generator = torch.Generator().manual_seed(0)
    actions = torch.rand(_ROWS, _HORIZON, action_dim, generator=generator, dtype=torch.float64) * 2 - 1
    actions = actions.to(dtype=action_dtype(state), device=state_device(state))
    problems = list(_problems(model, rows, actions, tolerance))
    if problems:
        raise ValueError(f"{type(model).__name__} cannot be planned with:\n- " + "\n- ".join(problems))
    return tuple(name for name in _OPTIONAL if supports(model, name))


def _problems(model: Any, state: State, actions: Tensor, tolerance: float) -> Iterator[str]:
    if not supports(model, "step"):
        yield "it has no step(state, action)"
        return
    answer = model.step(state, actions[:, 0])
    if not isinstance(answer, tuple) or len(answer) != 2:
        yield f"step() must return (next_state, reward), got {type(answer).__name__}"
        return
    basic = [*_vector_problems("step()'s reward", answer[1], (_ROWS,)), *_state_problems(state, answer[0])]
    yield from basic
    if not basic:
        yield from _row_problems(model, state, actions[:, 0], tolerance)
    yield from _optional_problems(model, state, actions)
    if not basic and supports(model, "fast_step"):
        yield from _fast_step_problems(model, state, actions[:, 0], tolerance)
    if not basic and supports(model, "rollout"):
        yield from _rollout_problems(model, state, actions, tolerance)


def _state_problems(state: State, following: State) -> Iterator[str]:
    if tree_structure(following) != tree_structure(state):
        yield "step() returns a state of another structure than it was given"
        return
    for before, after in zip(tree_leaves(state), tree_leaves(following), strict=True):
        if before.shape != after.shape or before.dtype != after.dtype:
            yield (
                f"step() turns a state of {tuple(before.shape)} {before.dtype} into {tuple(after.shape)} {after.dtype}"
            )
        elif not _is_finite(after):
            yield "step() returns NaN or infinity in the state"


def _optional_problems(model: Any, state: State, actions: Tensor) -> Iterator[str]:
    for name in ("value", "continues"):
        if supports(model, name):
            yield from _vector_problems(f"{name}()", getattr(model, name)(state), (_ROWS,))
    if supports(model, "uncertainty"):
        yield from _vector_problems("uncertainty()", model.uncertainty(state, actions[:, 0]), (_ROWS,))
    if supports(model, "policy"):
        generator = torch.Generator(actions.device).manual_seed(0)
        for name, argument in (("policy()'s mode", None), ("policy()'s sample", generator)):
            yield from _vector_problems(name, model.policy(state, argument), tuple(actions[:, 0].shape))
    if supports(model, "propose"):
        generators = [torch.Generator(actions.device).manual_seed(row) for row in range(_ROWS)]
        proposed = model.propose(state, 2, actions.shape[1], generators)
        yield from _vector_problems("propose()", proposed, (2 * _ROWS, *actions.shape[1:]))
    if supports(model, "particles") and count_rows(model.particles(state, 2)) != 2 * _ROWS:
        yield f"particles() must return {2 * _ROWS} rows for {_ROWS} states and 2 particles"


def _row_problems(model: Any, state: State, action: Tensor, tolerance: float) -> Iterator[str]:
    together = model.step(state, action)
    if not _agree(together, model.step(state, action), tolerance):
        return  # a step that samples: which row gets which draw is the model's own business
    alone = model.step(tree_map(lambda leaf: leaf[:1], state), action[:1])
    if not _agree(tree_map(lambda leaf: leaf[:1], together), alone, tolerance):
        yield "rows influence each other: step() gives a row something else when it comes alone"


def _fast_step_problems(model: Any, state: State, action: Tensor, tolerance: float) -> Iterator[str]:
    if not _agree(model.fast_step(state, action), model.step(state, action), 10 * tolerance):
        yield "fast_step() does not agree with step()"


def _rollout_problems(model: Any, state: State, actions: Tensor, tolerance: float) -> Iterator[str]:
    rewards, last = model.rollout(state, actions)
    yield from _vector_problems("rollout()'s rewards", rewards, tuple(actions.shape[:2]))
    stepped = []
    for action in actions.unbind(dim=1):
        state, reward = model.step(state, action)
        stepped.append(reward)
    expected = torch.stack(stepped, dim=1)
    if rewards.shape == expected.shape and not _agree((rewards, last), (expected, state), 10 * tolerance):
        yield "rollout() does not agree with step() after step()"


def _vector_problems(name: str, tensor: Any, shape: tuple[int, ...]) -> Iterator[str]:
    if not isinstance(tensor, Tensor):
        yield f"{name} must be a tensor, got {type(tensor).__name__}"
    elif tuple(tensor.shape) != shape:
        yield f"{name} must have shape {shape}, got {tuple(tensor.shape)}"
    elif not tensor.is_floating_point():
        yield f"{name} must be floating point, got {tensor.dtype}"
    elif not _is_finite(tensor):
        yield f"{name} is NaN or infinite"


def _is_finite(tensor: Tensor) -> bool:
    return not tensor.is_floating_point() or bool(torch.isfinite(tensor).all())


def _agree(left: Any, right: Any, tolerance: float) -> bool:
    pairs = zip(tree_leaves(left), tree_leaves(right), strict=True)
    return all(
        torch.allclose(a.double(), b.double(), rtol=tolerance, atol=tolerance * (1e-6 + float(b.double().abs().max())))
        for a, b in pairs
        if a.numel()
    )
