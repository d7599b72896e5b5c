"""Checks a model's methods before the first plan."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from numbers import Integral
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves, tree_map, tree_structure

from latentplan.planning.model import (
    Bound,
    Model,
    State,
    action_dtype,
    call_with,
    count_rows,
    describe_step_result,
    is_sampling,
    state_device,
    supports,
)
from latentplan.planning.search.choices import Choices, read_choices
from latentplan.planning.search.registry import Planner
from latentplan.planning.search.space import read_bounds

_ROWS, _HORIZON, _NUM = 4, 3, 2
_OPTIONAL = ("value", "policy", "continues", "uncertainty", "rollout", "fast_step", "propose", "particles")
_PER_ROW = {"propose": _NUM, "particles": _NUM}  # rows that these methods return per row of their input

Inputs = tuple[State, Tensor]  # states (rows, ...) and actions (rows, horizon, action)

_ARGUMENTS: dict[str, Callable[[State, Tensor], tuple[Any, ...]]] = {
    "step": lambda state, actions: (state, actions[:, 0]),
    "value": lambda state, actions: (state,),
    "policy": lambda state, actions: (state, None),
    "continues": lambda state, actions: (state,),
    "uncertainty": lambda state, actions: (state, actions[:, 0]),
    "rollout": lambda state, actions: (state, actions),
    "fast_step": lambda state, actions: (state, actions[:, 0]),
    "propose": lambda state, actions: (state, _NUM, actions.shape[1], _make_generators(actions)),
    "particles": lambda state, actions: (state, _NUM),
}


@torch.no_grad()
def check_model(
    model: Model,
    state: State,
    action_dim: int | None = None,
    *,
    planner: Planner | None = None,
    action_low: Bound = -1.0,
    action_high: Bound = 1.0,
    action_choices: Any = None,
    tolerance: float = 1e-3,
) -> tuple[str, ...]:
    """Calls every method of a model and raises an error that lists every problem found.

    Args:
        model: The model.
        state: A typical state, any number of rows.
        action_dim: Numbers in an action.
        planner: A planner whose `action_dim`, bounds and discrete actions the check uses, in place of the arguments.
        action_low: Lowest action of the check, see `CEMPlanner`.
        action_high: Highest action of the check.
        action_choices: Discrete actions of the check, see `CEMPlanner`.
        tolerance: Relative difference that is allowed between two results that must agree.

    Returns:
        Names of the optional methods that the model has.

    Raises:
        TypeError: The state is not a tensor or a pytree of tensors, or neither `action_dim` nor `planner` is given.
        ValueError: There are problems; the message lists them, one per line: exceptions, shapes, dtypes, NaN, rows that
            influence each other or come in another order, changed inputs, a rollout that does not agree with steps.
    """
    if planner is not None:
        action_dim, action_low, action_high = planner.action_dim, planner.action_low, planner.action_high
        action_choices = getattr(planner, "action_choices", None)
    if action_dim is None:
        raise TypeError("check_model() needs action_dim or planner")
    index = torch.arange(_ROWS, device="cpu") % count_rows(state)
    rows = tree_map(lambda leaf: leaf[index.to(leaf.device)], state)
    choices = read_choices(action_choices, action_dim)
    actions = _draw_actions(*read_bounds(action_low, action_high, action_dim, choices))
    actions = actions.to(dtype=action_dtype(state), device=state_device(state))
    if choices:
        actions = Choices(choices, actions.dtype, actions.device).snap(actions)
    checked = _Seeded(model, actions.device) if is_sampling(model) else model
    problems = list(_find_problems(checked, rows, actions, tolerance))
    if problems:
        problems += _explain_rows(state)
        raise ValueError(f"{type(model).__name__} cannot be planned with:\n- " + "\n- ".join(problems))
    return tuple(name for name in _OPTIONAL if supports(model, name))


class _Seeded:
    """A model that samples, with a stream of its own, so that its methods can be called without one."""

    def __init__(self, model: Any, device: torch.device) -> None:
        self._model = model
        generator = torch.Generator(device).manual_seed(0)
        for name in ("step", "fast_step", "rollout"):
            if supports(model, name):
                method = getattr(model, name)
                setattr(self, name, lambda *given, method=method: call_with(method, generator, *given))

    def __getattr__(self, name: str) -> Any:  # called for attributes that this class lacks
        return getattr(self._model, name)


def _draw_actions(low: Tensor, high: Tensor) -> Tensor:
    """Returns actions within the bounds of the first steps and of the first environment, (rows, horizon, action)."""
    generator = torch.Generator().manual_seed(0)
    drawn = torch.rand(_ROWS, _HORIZON, low.shape[-1], generator=generator, dtype=torch.float64, device="cpu")
    steps = torch.arange(_HORIZON, device="cpu")
    lowest, highest = (bound[:1, steps.clamp_max(bound.shape[1] - 1)] for bound in (low, high))
    return lowest + (highest - lowest) * drawn


def _explain_rows(state: State) -> list[str]:
    """Returns what the rows of a state are, if its shape may be the reason of a problem."""
    shapes = [tuple(leaf.shape) for leaf in tree_leaves(state)]
    if len(shapes) == 1 and len(shapes[0]) == 1:
        return [
            f"perhaps: a state of shape {shapes[0]} is {shapes[0][0]} environments with one number each; "
            "pass state[None] if it is one environment"
        ]
    if any(len(shape) > 2 for shape in shapes):
        shape = next(shape for shape in shapes if len(shape) > 2)
        return [
            f"perhaps: a state of shape {shape} is {shape[0]} environments with features {shape[1:]}; pass "
            "state.flatten(0, 1) if its first two dimensions are environments"
        ]
    return []


def _find_problems(model: Any, state: State, actions: Tensor, tolerance: float) -> Iterator[str]:
    """Yields the problems of a model for states (rows, ...) and actions (rows, horizon, action)."""
    if not supports(model, "step"):
        yield "the model has no step(state, action)"
        return
    particles = getattr(model, "num_particles", 1)
    if isinstance(particles, bool) or not isinstance(particles, Integral) or particles < 1:
        yield f"num_particles must be a whole number, at least 1, got {particles!r}"
    problems, following = _try(model, "step", (state, actions))
    yield from problems
    if problems:
        following = None
    # After a step the rows differ, even if all rows of the given state are equal.
    inputs = (state if following is None else following[0], actions)
    for name in ("step", *_OPTIONAL):
        if name == "step" and following is None or not supports(model, name):
            continue
        problems, result = _try(model, name, inputs)
        yield from problems
        if not problems:
            yield from _check_rows(model, name, inputs, result, tolerance)
    if supports(model, "policy"):
        yield from _check_sample(model, inputs)
    if following is not None:
        first = tree_map(lambda leaf: leaf[torch.zeros(_ROWS, dtype=torch.long, device=leaf.device)], state)
        yield from _check_agreement(model, (first, actions), tolerance)


def _try(model: Any, name: str, inputs: Inputs) -> tuple[list[str], Any]:
    """Returns the problems of a method, and its result; None if the method raised an exception."""
    given = _ARGUMENTS[name](*inputs)
    return _call(model, name, given, lambda result: _check_result(name, result, inputs))


def _call(model: Any, name: str, given: tuple[Any, ...], find: Callable[[Any], Iterator[str]]) -> tuple[list[str], Any]:
    """Returns the problems of a call (exceptions, changed inputs, and problems that `find` yields), and its result."""
    copies = tree_map(lambda leaf: leaf.clone() if isinstance(leaf, Tensor) else leaf, given)
    try:
        result = getattr(model, name)(*copies)
        problems = list(find(result))
    except Exception as error:
        return [f"{name}() raises {type(error).__name__}: {error}{_explain_error(error)}"], None
    pairs = zip(tree_leaves(given), tree_leaves(copies), strict=True)
    if any(isinstance(before, Tensor) and not _is_same(before, after) for before, after in pairs):
        problems.append(f"{name}() changes its inputs; it has to return new tensors")
    return problems, result


def _explain_error(error: Exception) -> str:
    """Returns a hint where actions that are floating-point numbers seem to be the reason of an exception."""
    text = str(error).lower()
    if any(sign in text for sign in ("used as indices", "expected dtype int64 for index", "only integer tensors")):
        return "; actions are floating point: use action.long() as an index, and action_choices for discrete actions"
    return ""


def _check_result(name: str, result: Any, inputs: Inputs) -> Iterator[str]:
    """Yields the problems of a method's result."""
    state, actions = inputs
    rows, horizon = actions.shape[:2]
    if name in ("step", "fast_step", "rollout"):
        shape, order = ((rows,), "(next_state, reward)") if name != "rollout" else ((rows, horizon), "(rewards, state)")
        if not isinstance(result, tuple) or len(result) != 2:
            is_step = name == "step"
            yield (
                describe_step_result(result)
                if is_step
                else f"{name}() must return {order}, got {type(result).__name__}"
            )
            return
        rewards, last = result if name == "rollout" else result[::-1]
        yield from _check_tensor(f"{name}()'s reward" + "s" * (name == "rollout"), rewards, shape)
        yield from _check_state(name, state, last)
    elif name == "particles":
        if tree_structure(result) != tree_structure(state):
            yield "particles() returns a state of another structure than it was given"
        elif count_rows(result) != _NUM * rows:
            yield f"particles() must return {_NUM * rows} rows for {rows} states and {_NUM} particles"
        elif not all(_is_finite(leaf) for leaf in tree_leaves(result)):
            yield "particles() returns NaN or infinity"
    else:
        shapes = {"policy": actions[:, 0].shape, "propose": (_NUM * rows, *actions.shape[1:])}
        title = "policy()'s mode" if name == "policy" else f"{name}()"
        yield from _check_tensor(title, result, tuple(shapes.get(name, (rows,))))


def _check_state(name: str, state: State, following: State) -> Iterator[str]:
    """Yields the problems of the state that a method returned for a state."""
    if tree_structure(following) != tree_structure(state):
        yield f"{name}() returns a state of another structure than it was given"
        return
    for before, after in zip(tree_leaves(state), tree_leaves(following), strict=True):
        if before.shape != after.shape or before.dtype != after.dtype:
            new, old = (f"{tuple(leaf.shape)} {leaf.dtype}" for leaf in (after, before))
            yield f"{name}() turns a state of {old} into {new}"
        elif not _is_finite(after):
            yield f"{name}() returns NaN or infinity in the state"


def _check_rows(model: Any, name: str, inputs: Inputs, together: Any, tolerance: float) -> Iterator[str]:
    """Yields a problem if the first row has another result when it is the only row."""
    if not _agree(together, getattr(model, name)(*_ARGUMENTS[name](*inputs)), tolerance):
        return  # the method samples, so two results differ anyway
    state, actions = inputs
    problems, alone = _try(model, name, (tree_map(lambda leaf: leaf[:1], state), actions[:1]))
    if problems:
        yield from (f"of one row alone, {problem}" for problem in problems)
        return
    first = tree_map(lambda leaf: leaf[: _PER_ROW.get(name, 1)], together)
    if not _agree(first, alone, tolerance if name == "step" else 10 * tolerance):
        order = ", or rows are not batch-major" if name in _PER_ROW else ""
        yield f"rows influence each other: {name}() returns something else for a row that comes alone{order}"


def _check_sample(model: Any, inputs: Inputs) -> Iterator[str]:
    """Yields the problems of a sample of the policy."""
    state, actions = inputs
    shape = tuple(actions[:, 0].shape)
    given = (state, _make_generators(actions)[0])
    problems, _ = _call(model, "policy", given, lambda sample: _check_tensor("policy()'s sample", sample, shape))
    yield from problems


def _check_agreement(model: Any, inputs: Inputs, tolerance: float) -> Iterator[str]:
    """Yields a problem for each fused or fast method that does not agree with `step`."""
    state, actions = inputs
    if not _agree(model.step(state, actions[:, 0]), model.step(state, actions[:, 0]), tolerance):
        return  # the step samples, so two results differ anyway
    if supports(model, "fast_step") and not _try(model, "fast_step", inputs)[0]:
        if not _agree(model.fast_step(state, actions[:, 0]), model.step(state, actions[:, 0]), 10 * tolerance):
            yield "fast_step() does not agree with step()"
    if supports(model, "rollout") and not _try(model, "rollout", inputs)[0]:
        result, stepped = model.rollout(state, actions), []
        for action in actions.unbind(dim=1):
            state, reward = model.step(state, action)
            stepped.append(reward)
        if not _agree(result, (torch.stack(stepped, dim=1), state), 10 * tolerance):
            yield "rollout() does not agree with step() after step()"


def _check_tensor(name: str, tensor: Any, shape: tuple[int, ...]) -> Iterator[str]:
    if not isinstance(tensor, Tensor):
        yield f"{name} must be a tensor, got {type(tensor).__name__}"
    elif tuple(tensor.shape) != shape:
        yield f"{name} must have shape {shape}, got {tuple(tensor.shape)}"
    elif not tensor.is_floating_point():
        yield f"{name} must be floating point, got {tensor.dtype}"
    elif not _is_finite(tensor):
        yield f"{name} is NaN or infinite"


def _make_generators(actions: Tensor) -> list[torch.Generator]:
    return [torch.Generator(actions.device).manual_seed(row) for row in range(len(actions))]


def _is_same(before: Tensor, after: Tensor) -> bool:
    """Returns whether two tensors are equal, NaN included."""
    return before.shape == after.shape and bool(((before == after) | ((before != before) & (after != after))).all())


def _is_finite(tensor: Tensor) -> bool:
    return not tensor.is_floating_point() or bool(torch.isfinite(tensor).all())


def _agree(left: Any, right: Any, tolerance: float) -> bool:
    pairs = zip(tree_leaves(left), tree_leaves(right), strict=True)
    return all(
        torch.allclose(a.double(), b.double(), rtol=tolerance, atol=tolerance * (1e-6 + float(b.double().abs().max())))
        for a, b in pairs
        if a.numel()
    )
