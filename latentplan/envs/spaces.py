"""Which spaces of a user's environment are accepted, and how their values become an agent's and an agent's theirs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import gymnasium
import numpy as np
from gymnasium import spaces

from latentplan.config import EnvConfig, UserError
from latentplan.config.spaces import MOST_CAMERAS, MOST_CATEGORIES, MOST_NUMBERS, Spaces
from latentplan.envs.faults import check_picture, check_unit_picture, check_vector, take_keys

LARGEST_RANGE = 1e6  # from the lowest to the highest value of an action; a longer one was not meant
ONLY_PICTURE = "picture"  # name of the picture of an environment that shows one and no Dict
CHANNELS = (1, 3, 4)  # gray, RGB, RGB with alpha, along the last axis of a picture
FIRST_CHANNELS = (1, 3)  # along the first axis, where 4 pictures are a stack of gray ones and no alpha channel
PICTURES = "a picture (height, width, 3), gray or with alpha, of uint8 or of floats in [0, 1]"


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
        shaped = self.scale(numbers).astype(self.space.dtype).reshape(self.space.shape)
        return shaped[()] if isinstance(self.space, spaces.Discrete) else shaped

    def scale(self, numbers: np.ndarray) -> np.ndarray:
        """Numbers in [-1, 1] in the units of the space, float64 (..., number)."""
        part = (np.clip(numbers, -1.0, 1.0) + 1.0) * 0.5
        if any(self.choices):
            counts = np.array(self.choices)
            return self.low + np.minimum(np.floor(part * counts), counts - 1)
        scaled = (self.low + part * (self.high - self.low)).clip(self.low, self.high)
        return scaled if np.issubdtype(self.space.dtype, np.floating) else np.rint(scaled)

    def unscale(self, values: np.ndarray) -> np.ndarray:
        """The inverse of `scale`, float64 (..., number); a choice becomes the middle of its part of the interval."""
        if any(self.choices):
            return (2.0 * (values - self.low) + 1.0) / np.array(self.choices) - 1.0
        width = self.high - self.low
        return 2.0 * (values - self.low) / np.where(width > 0.0, width, 1.0) - (width > 0.0)


class Actions:
    """Values of an action space as numbers in [-1, 1], all side by side.

    A bounded Box gives its numbers, mapped linearly; those of a Box of integers are rounded. Discrete, MultiDiscrete
    and MultiBinary give one number for each choice (see `latentplan.config.spaces.Spaces`), but none for a choice of
    one category. Dict and Tuple give the numbers of their parts, in the order of the space.

    Args:
        space: The action space of an environment.

    Raises:
        UserError: The space is another, is not bounded, or has a range above `LARGEST_RANGE`; the message names the
            remedy.

    Attributes:
        dim: Numbers of an action.
        choices: See `Spaces`; empty if all numbers are continuous.
        bounds: All numbers of the space in its own units: the lowest and the highest value of each, and its categories
            (0 for a continuous number), float64 (3, own number). These are the numbers of an action, and those of
            choices of one category.
    """

    def __init__(self, space: gymnasium.Space[Any]) -> None:
        self._space = space
        self._parts = list(_read_parts(space, "action_space"))
        choices = [num for part in self._parts for num in part.choices]
        ends = [np.concatenate([getattr(part, end) for part in self._parts] or [[]]) for end in ("low", "high")]
        self.bounds = np.stack([*ends, np.array(choices, np.float64)])
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
        values = iter(self._split(numbers))
        parts = iter([part.value(own) for part, own in zip(self._parts, values, strict=True)])
        return _rebuild(self._space, parts)

    def to_own(self, actions: np.ndarray) -> np.ndarray:
        """Actions (..., dim) in the units of the space, float64 (..., own number), in the order of `bounds`."""
        numbers = np.zeros((*actions.shape[:-1], len(self._is_given)))
        numbers[..., self._is_given] = actions
        values = zip(self._parts, self._split(numbers), strict=True)
        return np.concatenate([part.scale(own) for part, own in values], axis=-1)

    def from_own(self, values: np.ndarray) -> np.ndarray:
        """The inverse of `to_own`: actions in [-1, 1], float32 (..., dim)."""
        parts = zip(self._parts, self._split(np.asarray(values, np.float64)), strict=True)
        numbers = np.concatenate([part.unscale(own) for part, own in parts], axis=-1)
        return numbers[..., self._is_given].clip(-1.0, 1.0).astype(np.float32)

    def flatten(self, values: Any) -> np.ndarray:
        """Values of the space, nested as the space with the axis of time first, as numbers float64 (time, own number).

        Raises:
            ValueError: The values do not have the form of the space.
        """
        found = list(_leaves(self._space, values))
        return np.concatenate([np.asarray(leaf, np.float64).reshape(len(leaf), -1) for leaf in found], axis=1)

    def _split(self, numbers: np.ndarray) -> list[np.ndarray]:
        """Numbers of the whole space (..., own number) as those of its parts."""
        return np.split(numbers, np.cumsum([len(part.choices) for part in self._parts])[:-1], axis=-1)


@dataclass(frozen=True)
class Interface:
    """What an environment shows and takes, by its own names and in its own units, as recorded episodes keep it.

    Attributes:
        pictures: Names of the pictures that lie side by side in a frame, in order.
        vectors: Names of the vectors beside the frame, in order, and the numbers of each.
        action_space: The environment's own action space.
    """

    pictures: tuple[str, ...]
    vectors: tuple[tuple[str, int], ...]
    action_space: gymnasium.Space[Any]


@dataclass(frozen=True)
class Accepted:
    """An environment's spaces as agents use them.

    Attributes:
        observations: Makes frames of observations.
        actions: Makes values of the action space from the numbers of an agent.
        spaces: What the networks have to know.
    """

    observations: Observations
    actions: Actions
    spaces: Spaces


def accept_spaces(
    observation_space: gymnasium.Space[Any], action_space: gymnasium.Space[Any], config: EnvConfig | None = None
) -> Accepted:
    """Decides whether agents can learn in an environment with these spaces, before anything else is made.

    Args:
        observation_space: Space of the observations.
        action_space: Space of the actions.
        config: Size of the frames, names of cameras and vectors; None takes the defaults.

    Raises:
        UserError: A space is not accepted; one line names the space, what it is and the remedy.
    """
    config = config or EnvConfig()
    observations = Observations(observation_space, config.frame_size, config.cameras, config.vectors)
    actions = Actions(action_space)
    return Accepted(observations, actions, replace(observations.spaces, choices=actions.choices))


class Picture:
    """Pictures of one space as RGB bytes.

    Accepted are (height, width, channel) with 1, 3 or 4 channels, (channel, height, width) with 1 or 3, and
    (height, width): of whole numbers within 0 to 255, or of floats whose space has the bounds 0 and 1. Whole numbers
    whose space has the bounds 0 and 1 become 0 and 255. Gray becomes RGB, and a picture with an alpha channel is laid
    over black.

    Args:
        space: Space of the pictures.
        name: Place of the space, for messages.

    Raises:
        UserError: The space is another; the message names the remedy.
    """

    def __init__(self, space: gymnasium.Space[Any], name: str) -> None:
        if not is_picture(space):
            raise UserError(f"{name} must be {PICTURES}, got {_describe(space)}: {_find_remedy(space)}")
        shape: tuple[int, ...] = space.shape or ()
        self._shape, self._is_unit = shape, _has_unit_bounds(space)
        self._is_channel_first = len(shape) == 3 and shape[2] not in CHANNELS

    def read(self, value: Any) -> np.ndarray:
        """The picture, a new uint8 array (height, width, 3).

        Raises:
            EnvironmentFault: The value is not as the space declares.
        """
        picture = check_unit_picture(value, self._shape) if self._is_unit else check_picture(value, self._shape)
        if picture.ndim == 2:
            picture = picture[..., None]
        elif self._is_channel_first:
            picture = np.moveaxis(picture, 0, 2)
        if picture.shape[2] == 4:
            seen = picture[..., :3].astype(np.uint16) * picture[..., 3:]
            return ((seen + 127) // 255).astype(np.uint8)
        return np.ascontiguousarray(np.broadcast_to(picture, (*picture.shape[:2], 3)))


class Observations:
    """Observations of an environment as the frames of an agent.

    Args:
        space: The observation space: pictures (see `Picture`), or a Dict that holds some.
        frame_size: Side of the frames.
        cameras: Keys of the pictures that the agent sees, in this order; empty takes all pictures of a Dict that
            `vectors` does not name, at most 16.
        vectors: Keys of the vectors that the agent sees beside them, in this order: Boxes of any shape.

    Raises:
        UserError: There are no such pictures or vectors; the message names the remedy.

    Attributes:
        spaces: What the networks have to know.
    """

    def __init__(
        self, space: gymnasium.Space[Any], frame_size: int, cameras: Sequence[str] = (), vectors: Sequence[str] = ()
    ) -> None:
        self._frame_size, self._keys, self._vectors = frame_size, list(cameras), list(vectors)
        self._vector_shapes = [find_vector(space, key).shape for key in vectors]
        if not isinstance(space, spaces.Dict):
            if cameras:
                raise _refuse_key(space, "cameras", cameras[0])
            self._pictures = [Picture(space, "observation_space")]
        else:
            self._keys = self._keys or _find_pictures(space, vectors)
            _check_cameras(space, self._keys, vectors)
            self._pictures = [Picture(space[key], f"observation_space[{key!r}]") for key in self._keys]
        vector_dim = sum(math.prod(shape) for shape in self._vector_shapes)
        if vector_dim > MOST_NUMBERS:
            raise UserError(
                f"env.vectors name {vector_dim} numbers, and at most {MOST_NUMBERS} are allowed: name fewer"
            )
        self.spaces = Spaces(frame_size=frame_size, cameras=len(self._pictures), vector_dim=vector_dim)

    @property
    def pictures(self) -> tuple[str, ...]:
        """Names of the pictures of a frame, in order; `picture` for the only one of a space that is no Dict."""
        return tuple(self._keys) or (ONLY_PICTURE,)

    @property
    def vectors(self) -> tuple[tuple[str, int], ...]:
        """Names of the vectors, in order, and the numbers of each."""
        sizes = [math.prod(shape) for shape in self._vector_shapes]
        return tuple(zip(self._vectors, sizes, strict=True))

    def read_vectors(self, observation: Any) -> np.ndarray:
        """The numbers beside the frame, a new float32 array (vector_dim,).

        Raises:
            EnvironmentFault: The observation is not as the space declares.
        """
        values = zip(take_keys(observation, self._vectors), self._vector_shapes, strict=True)
        return np.concatenate([np.ravel(check_vector(value, shape)) for value, shape in values])

    def read(self, observation: Any) -> tuple[np.ndarray, np.ndarray]:
        """The frame, a new uint8 array (frame_size, frame_size, 3 * camera), and the first camera's whole picture.

        Raises:
            EnvironmentFault: The observation is not as the space declares.
        """
        if not self._keys:
            picture = self._pictures[0].read(observation)
            return resize(picture, self._frame_size), picture
        values = take_keys(observation, self._keys)
        pictures = [picture.read(value) for picture, value in zip(self._pictures, values, strict=True)]
        return np.concatenate([resize(picture, self._frame_size) for picture in pictures], axis=2), pictures[0]


def _find_pictures(space: spaces.Dict, vectors: Sequence[str]) -> list[str]:
    """The keys of the pictures of a Dict that are not taken as vectors."""
    found = [key for key, part in space.spaces.items() if is_picture(part) and key not in vectors]
    if not found:
        beside = " beside those that env.vectors names" if vectors else ""
        raise UserError(f"observation_space must hold {PICTURES}{beside}, got {_describe(space)}: add one to the Dict")
    return found


def _check_cameras(space: spaces.Dict, keys: Sequence[str], vectors: Sequence[str]) -> None:
    for key in keys:
        if key not in space.spaces:
            raise _refuse_key(space, "cameras", key)
        if key in vectors:
            raise UserError(f"env.cameras and env.vectors both name {key!r}: name it in one of them")
    if len(keys) > MOST_CAMERAS:
        raise UserError(
            f"observation_space holds {len(keys)} pictures, and at most {MOST_CAMERAS} are allowed: name at most "
            f"{MOST_CAMERAS} with env.cameras"
        )


def find_vector(space: gymnasium.Space[Any], key: str) -> spaces.Box:
    """The space of the vectors at a key of an observation space.

    Args:
        space: The observation space.
        key: A key that `env.vectors` names.

    Raises:
        UserError: The space is no Dict, or holds no numbers at the key; the message names the remedy.
    """
    if not isinstance(space, spaces.Dict) or key not in space.spaces:
        raise _refuse_key(space, "vectors", key)
    part = space[key]
    if not isinstance(part, spaces.Box) or not np.issubdtype(part.dtype, np.number):
        raise UserError(
            f"observation_space[{key!r}], which env.vectors names, must be a Box of numbers, got {_describe(part)}: "
            "convert it with gymnasium.wrappers.TransformObservation"
        )
    return part


def _refuse_key(space: gymnasium.Space[Any], setting: str, key: str) -> UserError:
    """The refusal of a key that a setting names and a space lacks."""
    if not isinstance(space, spaces.Dict):
        return UserError(
            f"env.{setting} names {key!r}, but observation_space is {_describe(space)}: return a Dict with these keys, "
            f"or leave env.{setting} empty"
        )
    fits = [name for name, part in space.spaces.items() if is_picture(part) == (setting == "cameras")]
    return UserError(f"env.{setting} names {key!r}, which observation_space lacks; it has {', '.join(fits) or 'none'}")


def is_picture(space: gymnasium.Space[Any]) -> bool:
    """Whether values of a space are pictures that `Picture` reads."""
    if not isinstance(space, spaces.Box) or not _has_picture_shape(space.shape):
        return False
    is_whole = np.issubdtype(space.dtype, np.integer)
    return _has_unit_bounds(space) or bool(is_whole and (space.low >= 0).all() and (space.high <= 255).all())


def _has_picture_shape(shape: tuple[int, ...]) -> bool:
    if not 2 <= len(shape) <= 3 or 0 in shape:
        return False
    return len(shape) == 2 or shape[2] in CHANNELS or shape[0] in FIRST_CHANNELS


def _has_unit_bounds(space: gymnasium.Space[Any]) -> bool:
    """Whether a space holds numbers, floats or whole ones, with the bounds 0 and 1."""
    if not isinstance(space, spaces.Box) or not np.issubdtype(space.dtype, np.number):
        return False
    return bool((space.low == 0).all() and (space.high == 1).all())


def _find_remedy(space: gymnasium.Space[Any]) -> str:
    """What makes pictures of a space that holds none."""
    if not isinstance(space, spaces.Box):
        return "return pictures, for instance by gymnasium.wrappers.AddRenderObservation(env)"
    if len(space.shape) < 2:
        return "return pictures, for instance by gymnasium.wrappers.AddRenderObservation(env), or a Dict with a picture"
    if not _has_picture_shape(space.shape):
        if len(space.shape) == 3 and space.shape[0] == 4:
            return (
                "return the newest picture of a stack alone, without gymnasium.wrappers.FrameStackObservation, because "
                "an agent remembers earlier pictures; the channels of RGBA are the last axis, (height, width, 4)"
            )
        return "change their shape by gymnasium.wrappers.ReshapeObservation(env, shape), or return several in a Dict"
    if not space.is_bounded():
        return "declare their range, Box(0, 255, shape, numpy.uint8) or Box(0.0, 1.0, shape, numpy.float32)"
    if np.issubdtype(space.dtype, np.floating):
        return "scale them, for instance by gymnasium.wrappers.RescaleObservation(env, 0.0, 1.0)"
    low, high = int(space.low.min()), int(space.high.max())
    return (
        "scale them, for instance by gymnasium.wrappers.TransformObservation(env, lambda picture: "
        f"numpy.interp(picture, ({low}, {high}), (0, 255)).astype('uint8'), "
        f"gymnasium.spaces.Box(0, 255, {space.shape}, 'uint8'))"
    )


def resize(picture: np.ndarray, size: int) -> np.ndarray:
    """The picture at another size, a new uint8 array (size, size, 3)."""
    if picture.shape[:2] == (size, size):
        return picture.copy()
    height, width = (min(side, size) for side in picture.shape[:2])
    if (height, width) != picture.shape[:2]:  # a side that shrinks is averaged, also where the other one grows
        picture = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
    return cv2.resize(picture, (size, size), interpolation=cv2.INTER_LINEAR)


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
            "instance by gymnasium.wrappers.TransformAction(env, lambda action: action, "
            f"gymnasium.spaces.Box(-1.0, 1.0, {space.shape}))"
        )
    low, high = (np.ravel(bound).astype(np.float64) for bound in (space.low, space.high))
    if (high - low).max(initial=0.0) > LARGEST_RANGE:
        raise UserError(
            f"{name} ranges from {low.min():g} to {high.max():g}, further than {LARGEST_RANGE:g}: declare the values "
            "that move the body"
        )
    return _Numbers(space, low, high, (0,) * len(low))


def _leaves(space: gymnasium.Space[Any], values: Any) -> Iterator[Any]:
    """The values of the parts of a space, in the order of `_read_parts`.

    Raises:
        ValueError: The values do not have the form of the space.
    """
    if isinstance(space, spaces.Dict):
        if not isinstance(values, dict) or set(values) != set(space.spaces):
            raise ValueError(f"no values of {_describe(space)}")
        for key, part in space.spaces.items():
            yield from _leaves(part, values[key])
    elif isinstance(space, spaces.Tuple):
        if not isinstance(values, tuple | list) or len(values) != len(space.spaces):
            raise ValueError(f"no values of {_describe(space)}")
        for part, value in zip(space.spaces, values, strict=True):
            yield from _leaves(part, value)
    else:
        yield values


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
