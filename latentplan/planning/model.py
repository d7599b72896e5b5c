"""The methods that a planner calls on a model, and a model made of functions.

A model needs one method, `step`. Optional methods and attributes are detected by name:

    step(state, action) -> (next_state, reward)      state: tensor or pytree, dim 0 = rows; action (rows, action)
    value(state) -> (rows,)                          expected return from a state on
    policy(state, generator) -> (rows, action)       a sample; with None as the generator, the mode
    continues(state) -> (rows,)                      probability that the episode goes on from this state
    uncertainty(state, action) -> (rows,)            uncertainty of the model about that step, at least 0
    rollout(state, actions (rows, horizon, action)) -> (rewards (rows, horizon), last_state)     fused fast path
    fast_step(state, action)                         the same as step, faster; need not pass gradients
    propose(state, num, horizon, generators) -> actions (batch num, horizon, action)    fused: sequences of the policy,
                                                     the mode first, then samples, one generator per row of state
    particles(state, num) -> state                   `num` versions of each row, batch-major: (batch num) rows
    num_particles                                    number of versions in which every candidate is scored, default 1

    shown_as(view) -> model                          for a model that wraps another: the same wrapper around the view of
                                                     the inner model, see `latentplan.planning.conditioned`

Every row of an output must depend on the same row of the inputs only, and a method must not change its inputs.

A method that samples takes a third argument `generator` (`step`, `fast_step`, `rollout`) and draws from it; a search
passes the same stream to all calls, so that plans repeat.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from types import FunctionType
from typing import Any, Protocol
from weakref import WeakKeyDictionary

import torch
from einops import rearrange
from torch import Tensor
from torch.utils._pytree import register_pytree_node, tree_leaves, tree_map

State = Any  # a tensor, or a pytree (tuple, NamedTuple, dict, list, dataclass) of tensors, dim 0 = rows
Bound = float | Sequence[Any] | Tensor  # one number, (action,), (horizon, action) or (batch, horizon, action)


_parameters: WeakKeyDictionary[FunctionType, Mapping[str, inspect.Parameter]] = WeakKeyDictionary()


class Model(Protocol):
    """The one method that every model has; optional methods are listed at the top of this module."""

    def step(self, state: State, action: Tensor) -> tuple[State, Tensor]:
        """Returns the next state, and the reward (rows,) of taking action (rows, action) in state."""
        ...


class FunctionModel:
    """A model made of functions.

    Args:
        dynamics: `dynamics(state, action) -> next_state`; dynamics that sample take an argument `generator` too.
        reward: `reward(state, action) -> (rows,)`, of the state before the step.
        value: `value(state) -> (rows,)`, the expected return from the last state of a plan on.
        policy: `policy(state, generator) -> (rows, action)`; the mode if the generator is None.
        continues: `continues(state) -> (rows,)`, the probability that the episode goes on.
        uncertainty: `uncertainty(state, action) -> (rows,)`.
        rollout: `rollout(state, actions) -> (rewards (rows, horizon), last_state)`.
    """

    def __init__(
        self,
        dynamics: Callable[[State, Tensor], State],
        reward: Callable[[State, Tensor], Tensor],
        value: Callable[[State], Tensor] | None = None,
        policy: Callable[[State, torch.Generator | None], Tensor] | None = None,
        continues: Callable[[State], Tensor] | None = None,
        uncertainty: Callable[[State, Tensor], Tensor] | None = None,
        rollout: Callable[[State, Tensor], tuple[Tensor, State]] | None = None,
    ) -> None:
        self.dynamics = dynamics
        self.reward = reward
        if takes_generator(dynamics):  # a planner detects by the signature that the step samples
            self.step = self._sample_step  # type: ignore[method-assign]
        optional = {
            "value": value,
            "policy": policy,
            "continues": continues,
            "uncertainty": uncertainty,
            "rollout": rollout,
        }
        for name, function in optional.items():
            if function is not None:  # a planner detects an optional method by the attribute
                setattr(self, name, function)

    def step(self, state: State, action: Tensor) -> tuple[State, Tensor]:
        """Returns the next state, and the reward (rows,) of the step."""
        return self.dynamics(state, action), self.reward(state, action)

    def _sample_step(
        self, state: State, action: Tensor, generator: torch.Generator | None = None
    ) -> tuple[State, Tensor]:
        return call_with(self.dynamics, generator, state, action), self.reward(state, action)


def supports(model: object, method: str) -> bool:
    """Returns whether the model has this optional method."""
    return callable(getattr(model, method, None))


def require(model: object, method: str, reason: str) -> None:
    """Refuses a model without a method that a setting needs.

    Raises:
        ValueError: The model lacks the method.
    """
    if not supports(model, method):
        raise ValueError(f"{reason} needs a model with {method}(), which {type(model).__name__} does not have")


def has_policy(model: object) -> bool:
    """Returns whether the model proposes actions, by `policy` or by `propose`."""
    return supports(model, "policy") or supports(model, "propose")


def takes_generator(function: Callable[..., Any]) -> bool:
    """Returns whether a function, or the `forward` of a module, has an argument `generator`."""
    return "generator" in find_parameters(function)


def takes(function: Callable[..., Any], name: str) -> bool:
    """Returns whether a function can be given an argument by name."""
    parameters = find_parameters(function)
    return name in parameters or any(each.kind is each.VAR_KEYWORD for each in parameters.values())


def find_parameters(function: Callable[..., Any]) -> Mapping[str, inspect.Parameter]:
    """Returns the parameters of a function, or of the `forward` of a module, by name; empty without a signature."""
    function = function.forward if isinstance(function, torch.nn.Module) else function
    plain = getattr(function, "__func__", function)  # of a method; methods are made anew at each access
    if isinstance(plain, FunctionType):
        if plain not in _parameters:  # a signature takes longer to read than a small step
            _parameters[plain] = inspect.signature(plain).parameters
        return _parameters[plain]
    try:
        return inspect.signature(function).parameters
    except (TypeError, ValueError):  # a compiled function may have no signature
        return {}


def is_sampling(model: Any) -> bool:
    """Returns whether the model's steps or rollouts draw from a generator that they are given."""
    methods = ("step", "fast_step", "rollout")
    return any(supports(model, name) and takes_generator(getattr(model, name)) for name in methods)


def call_with(function: Callable[..., Any], generator: torch.Generator | None, *arguments: Any) -> Any:
    """Returns the result of a model's method, which is given the generator if the method takes one.

    Without a generator the method takes its own default, or None where it has no default.
    """
    wanted = find_parameters(function).get("generator")
    if wanted is None or (generator is None and wanted.default is not inspect.Parameter.empty):
        return function(*arguments)
    return function(*arguments, generator=generator)


def take_step(
    model: Any, state: State, action: Tensor, generator: torch.Generator | None = None
) -> tuple[State, Tensor]:
    """Returns the model's step; `fast_step` takes it if the model has one and gradients are off.

    Args:
        model: The model.
        state: States, rows (rows,).
        action: Actions, (rows, action).
        generator: Random stream of a model that samples; None leaves the stream to the model.

    Raises:
        ValueError: The step does not return two things.
    """
    is_fast = supports(model, "fast_step") and not torch.is_grad_enabled()
    following = call_with(model.fast_step if is_fast else model.step, generator, state, action)
    if not isinstance(following, (tuple, list)) or len(following) != 2:
        raise ValueError(describe_step_result(following))
    return following[0], following[1]


def describe_step_result(result: Any) -> str:
    """Returns the message for a step that does not return (next_state, reward)."""
    got = f"a tuple of {len(result)}" if isinstance(result, tuple) else type(result).__name__
    hint = "; of a gymnasium step, return the first two" if isinstance(result, tuple) and len(result) == 5 else ""
    return f"step() must return (next_state, reward), got {got}{hint}"


def count_rows(state: State) -> int:
    """Returns the size of dim 0, which is the same in every tensor of the state.

    Dataclasses in the state become pytrees: their fields are states too.

    Raises:
        TypeError: A leaf of the state is not a tensor.
        ValueError: The state holds no tensor, tensors whose rows differ, or no row.
    """
    leaves = tree_leaves(state)
    while any(_register_dataclass(leaf) for leaf in leaves):
        leaves = tree_leaves(state)
    for leaf in leaves:
        if not isinstance(leaf, Tensor):
            raise TypeError(f"a state is a tensor or a pytree of tensors, but holds a {type(leaf).__name__}")
    shapes = [tuple(leaf.shape) for leaf in leaves]
    if not shapes or any(len(shape) == 0 or shape[0] != shapes[0][0] for shape in shapes):
        raise ValueError(f"every tensor of a state needs the same rows in dim 0, got shapes {shapes}")
    if shapes[0][0] == 0:
        raise ValueError(f"a state needs at least one row, got shapes {shapes}")
    return shapes[0][0]


def _register_dataclass(leaf: Any) -> bool:
    """Registers the dataclass of a leaf as a pytree; returns whether the leaf was a dataclass."""
    if isinstance(leaf, Tensor) or isinstance(leaf, type) or not dataclasses.is_dataclass(leaf):
        return False
    kind = type(leaf)
    names = [field.name for field in dataclasses.fields(leaf)]

    def flatten(value: Any) -> tuple[list[Any], None]:
        return [getattr(value, name) for name in names], None

    def unflatten(values: Any, _: None) -> Any:
        made = object.__new__(kind)  # neither __init__ nor __post_init__ has to accept what a pytree holds
        for name, value in zip(names, values, strict=True):
            object.__setattr__(made, name, value)
        return made

    register_pytree_node(kind, flatten, unflatten)
    return True


def repeat_rows(state: State, num: int) -> State:
    """Returns each row `num` times, batch-major: row r becomes rows r * num to r * num + num - 1."""
    return tree_map(lambda leaf: leaf.repeat_interleave(num, dim=0), state)


def split_rows(state: State, batch: int) -> State:
    """Returns the state with its rows (batch sample) split into (batch, sample, ...)."""
    return tree_map(lambda leaf: rearrange(leaf, "(batch sample) ... -> batch sample ...", batch=batch), state)


def action_dtype(state: State) -> torch.dtype:
    """Returns the precision of actions and returns: float64 for a state in float64, otherwise float32."""
    is_double = any(leaf.dtype == torch.float64 for leaf in tree_leaves(state))
    return torch.float64 if is_double else torch.float32


def state_device(state: State) -> torch.device:
    """Returns the device of the state's tensors."""
    device: torch.device = tree_leaves(state)[0].device
    return device


def per_dimension(value: float | Sequence[float] | Tensor, action_dim: int, name: str) -> Tensor:
    """Returns the value for each action dimension, (action,), float64.

    Raises:
        ValueError: The value is neither one number nor one per dimension, or is not finite.
    """
    numbers = torch.as_tensor(value, dtype=torch.float64, device="cpu")
    if numbers.ndim > 1 or numbers.numel() not in (1, action_dim):
        raise ValueError(f"{name} must be one number or {action_dim} numbers, got shape {tuple(numbers.shape)}")
    if not bool(torch.isfinite(numbers).all()):
        raise ValueError(f"{name} must be finite, got {numbers.tolist()}")
    return numbers.expand(action_dim) if numbers.ndim == 0 or numbers.numel() == 1 else numbers


def per_step(value: Bound, action_dim: int, name: str) -> Tensor:
    """Returns the value for each environment, step and action dimension, (1 or batch, 1 or horizon, action), float64.

    Args:
        value: One number, one per dimension (action,), one per step (horizon, action), or (batch, horizon, action).
        action_dim: Numbers in an action.
        name: Name for errors.

    Raises:
        ValueError: The value has another shape, or is not finite.
    """
    numbers = torch.as_tensor(value, dtype=torch.float64, device="cpu")
    if numbers.ndim < 2:
        return per_dimension(numbers, action_dim, name)[None, None]
    if numbers.ndim > 3 or numbers.shape[-1] != action_dim:
        shape = tuple(numbers.shape)
        raise ValueError(f"{name} must end in {action_dim} numbers per step, (horizon, action), got shape {shape}")
    if not bool(torch.isfinite(numbers).all()):
        raise ValueError(f"{name} must be finite, got {numbers.tolist()}")
    return numbers[None] if numbers.ndim == 2 else numbers


def check_tensor(name: str, value: Any, shape: Sequence[int]) -> None:
    """Refuses a value, given by the user or returned by a user's function, that is not a tensor.

    Args:
        name: Name for errors.
        value: The value.
        shape: The shape that the tensor should have; only the message names it.

    Raises:
        TypeError: The value is not a tensor.
    """
    if not isinstance(value, Tensor):
        raise TypeError(f"{name} must be a tensor of shape {tuple(shape)}, got {type(value).__name__}")


def check_shape(name: str, tensor: Any, shape: Sequence[int]) -> None:
    """Refuses a value, given by the user or returned by a user's function, that is no tensor of a shape.

    Raises:
        TypeError: The value is not a tensor.
        ValueError: The shapes differ; the message has both.
    """
    check_tensor(name, tensor, shape)
    if tensor.shape != torch.Size(shape):
        raise ValueError(f"{name} must have shape {tuple(shape)}, got {tuple(tensor.shape)}")


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
        ValueError: The model samples: a compiled program cannot draw from the stream that a search passes to it.
        torch._dynamo.exc.BackendCompilerFailed: While planning, if torch finds no C++ compiler.
    """
    if is_sampling(model):
        raise ValueError("compile_rollout() needs a model that does not sample, but this one takes a generator")
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
