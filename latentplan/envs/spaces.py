"""Which spaces of a user's environment are accepted, and how their values become an agent's and an agent's theirs."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from latentplan.config import UserError
from latentplan.config.spaces import MOST_CATEGORIES, Spaces

MOST_NUMBERS = 4096  # of an action, as a checkpoint may name


@dataclass(frozen=True)
class _Numbers:
    """Numbers of an action that are the value of one space, flattened.

    Attributes:
        space: The space.
        low: Lowest value of each number, float64 (number,); the first category of a choice.
        high: Highest value of each number, float64 (number,).
        choices: Categories of each number; 0 for a continuous number, 1 for a number that has only one value.
    """

    space: gymnasium.Space[Any]
    low: np.ndarray
    high: np.ndarray
    choices: tuple[int, ...]

    def value(self, numbers: np.ndarray) -> Any:
        """The value of the space for numbers in [-1, 1], float64 (number,)."""
        part = (np.clip(numbers, -1.0, 1.0) + 1.0) * 0.5
        scaled = (self.low + part * (self.high - self.low)).clip(self.low, self.high)
        if not np.issubdtype(self.space.dtype, np.floating):
            scaled = np.rint(scaled)
        if any(self.choices):
            counts = np.array(self.choices)
            scaled = self.low + np.minimum(np.floor(part * counts), counts - 1)
        shaped = scaled.astype(self.space.dtype).reshape(self.space.shape)
        return shaped[()] if isinstance(self.space, spaces.Discrete) else shaped


class Actions:
    """Values of an action space as numbers in [-1, 1], all side by side.

    A bounded Box gives its numbers, mapped linearly; those of a Box of integers are rounded. Discrete, MultiDiscrete
    and MultiBinary give one number for each choice (see `latentplan.config.spaces.Spaces`), but none for a choice of
    one category. Dict and Tuple give the numbers of their parts, in the order of the space.

    Args:
        space: The action space of an environment.

    Raises:
        UserError: The space is another, or is not bounded; the message names the remedy.

    Attributes:
        dim: Numbers of an action.
        choices: See `Spaces`; empty if all numbers are continuous.
    """

    def __init__(self, space: gymnasium.Space[Any]) -> None:
        self._space = space
        self._parts = list(_read_parts(space, "action_space"))
        choices = [num for part in self._parts for num in part.choices]
        self._is_given = [num != 1 for num in choices]
        self.dim = sum(self._is_given)
        given = tuple(num for num in choices if num != 1)
        self.choices = given if any(given) else ()
        if not 1 <= self.dim <= MOST_NUMBERS:
            raise UserError(
                f"actions must have 1 to {MOST_NUMBERS} numbers, got {self.dim} from {_describe(space)}: give the "
                "environment an action_space that leaves a choice"
            )

    def value(self, action: np.ndarray) -> Any:
        """The value of the space for an action, finite numbers (dim,), clipped to [-1, 1]."""
        numbers = np.zeros(len(self._is_given))
        numbers[self._is_given] = action
        values = iter(np.split(numbers, np.cumsum([len(part.choices) for part in self._parts])[:-1]))
        parts = iter([part.value(own) for part, own in zip(self._parts, values, strict=True)])
        return _rebuild(self._space, parts)


@dataclass(frozen=True)
class Accepted:
    """An environment's spaces as agents use them.

    Attributes:
        actions: Makes values of the action space from the numbers of an agent.
        spaces: What the networks have to know.
    """

    actions: Actions
    spaces: Spaces


def accept_spaces(observation_space: gymnasium.Space[Any], action_space: gymnasium.Space[Any]) -> Accepted:
    """Decides whether agents can learn in an environment with these spaces, before anything else is made.

    Args:
        observation_space: Space of the observations.
        action_space: Space of the actions.

    Raises:
        UserError: A space is not accepted; one line names the space, what it is and the remedy.
    """
    check_observations(observation_space)
    actions = Actions(action_space)
    return Accepted(actions, Spaces(choices=actions.choices))


def check_observations(space: gymnasium.Space[Any]) -> None:
    """Refuses observations that are not pictures."""
    wanted = "observations must be a Box of uint8 images (height, width, 3)"
    if not isinstance(space, spaces.Box):
        raise UserError(f"{wanted}, got {type(space).__name__}")
    if space.dtype != np.uint8:
        raise UserError(f"{wanted}, got dtype {space.dtype}")
    if len(space.shape) != 3 or space.shape[2] != 3:
        raise UserError(f"{wanted}, got shape {space.shape}")


def _read_parts(space: gymnasium.Space[Any], name: str) -> Iterator[_Numbers]:
    """The parts of an action space, in order; `name` is its place, for messages."""
    if isinstance(space, spaces.Dict):
        for key, part in space.spaces.items():
            yield from _read_parts(part, f"{name}[{key!r}]")
    elif isinstance(space, spaces.Tuple):
        for place, part in enumerate(space.spaces):
            yield from _read_parts(part, f"{name}[{place}]")
    elif isinstance(space, spaces.Box):
        yield _read_box(space, name)
    elif isinstance(space, spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary):
        if isinstance(space, spaces.MultiBinary):
            counts, start = np.full(math.prod(space.shape), 2), np.zeros(math.prod(space.shape))
        else:
            counts = np.ravel(space.n if isinstance(space, spaces.Discrete) else space.nvec)
            start = np.ravel(space.start).astype(np.float64)
        if counts.size and counts.max() > MOST_CATEGORIES:
            raise UserError(
                f"{name} has a choice of {counts.max()} categories, and at most {MOST_CATEGORIES} are allowed: divide "
                "it into several choices (gymnasium.spaces.MultiDiscrete)"
            )
        yield _Numbers(space, start, start + counts - 1, tuple(map(int, counts)))
    else:
        raise UserError(
            f"{name} must be Box, Discrete, MultiDiscrete, MultiBinary, or a Dict or Tuple of them, got "
            f"{type(space).__name__}: convert it with gymnasium.wrappers.TransformAction"
        )


def _read_box(space: spaces.Box, name: str) -> _Numbers:
    if not (np.issubdtype(space.dtype, np.floating) or np.issubdtype(space.dtype, np.integer)):
        raise UserError(
            f"{name} must hold numbers, got dtype {space.dtype}: use gymnasium.spaces.MultiBinary for bools"
        )
    kind = space.dtype if np.issubdtype(space.dtype, np.floating) else np.float64
    with np.errstate(over="ignore", invalid="ignore"):
        is_finite = bool(np.isfinite(space.high.astype(kind) - space.low.astype(kind)).all())
    if not (is_finite and space.is_bounded()):
        raise UserError(
            f"{name} must be bounded, got {_describe(space)}: give the environment a bounded action_space, for "
            f"instance by gymnasium.wrappers.TransformAction(env, lambda action: action, gymnasium.spaces.Box(-1.0, 1.0, "
            f"{space.shape}))"
        )
    low, high = (np.ravel(bound).astype(np.float64) for bound in (space.low, space.high))
    return _Numbers(space, low, high, (0,) * len(low))


def _rebuild(space: gymnasium.Space[Any], parts: Iterator[Any]) -> Any:
    """A value of a space from the values of its parts, in the order of `_read_parts`."""
    if isinstance(space, spaces.Dict):
        return {key: _rebuild(part, parts) for key, part in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(_rebuild(part, parts) for part in space.spaces)
    return next(parts)


def _describe(space: gymnasium.Space[Any]) -> str:
    """A space in one short line."""
    text = " ".join(str(space).split())
    return text if len(text) <= 120 else f"{text[:120]}..."
