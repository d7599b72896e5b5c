"""What an environment may return, and how its failures are reported."""

from __future__ import annotations

import os
import traceback
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import DependencyNotInstalled

from latentplan.config import UserError
from latentplan.config.checks import EnvironmentFault, cut, shown
from latentplan.config.extras import describe_missing, extra_of

UNCHANGED_FRAMES = 100  # equal frames in a row after which a picture counts as constant
PLAIN_FRAMES = 10  # frames of one colour in a row after which a picture counts as blank
_OWN_FOLDERS = tuple(f"{folder}{os.sep}" for folder in (Path(__file__).parents[1], Path(gymnasium.__file__).parent))
_GYMNASIUM_ENVS = f"{Path(gymnasium.__file__).parent / 'envs'}{os.sep}"


def check_picture(picture: Any, shape: tuple[int, ...]) -> np.ndarray:
    """An observation as an array of its own, uint8 of the shape that its space declares.

    Whole numbers of another type are accepted within 0 to 255.

    Raises:
        EnvironmentFault: The observation is none of this; the message says what it is.
    """
    wanted = f"the environment must return frames uint8 {shape}"
    try:
        given = np.asarray(picture)
    except UserError:  # of the environment's own render
        raise
    except (TypeError, ValueError):
        raise EnvironmentFault(f"{wanted}, got {type(picture).__name__}") from None
    if given.dtype == np.uint8 and given.shape == shape:
        return np.array(given)
    if given.dtype == object or given.shape == ():
        raise EnvironmentFault(f"{wanted}, got {shown(picture)}")
    if given.shape != shape:
        raise EnvironmentFault(f"{wanted}, got shape {given.shape}: declare in observation_space what it returns")
    if not np.issubdtype(given.dtype, np.integer):
        remedy = "return brightness 0 to 255 as np.uint8"
        raise EnvironmentFault(f"{wanted}, got {given.dtype} {_describe_range(given)}: {remedy}")
    if given.min() < 0 or given.max() > 255:
        raise EnvironmentFault(f"{wanted}, got values {given.min()} to {given.max()}: scale them to 0 to 255")
    return given.astype(np.uint8)


def check_unit_picture(picture: Any, shape: tuple[int, ...]) -> np.ndarray:
    """An observation of numbers in [0, 1] as an array of its own, uint8 of the shape that its space declares.

    Raises:
        EnvironmentFault: The observation is none of this; the message says what it is.
    """
    wanted = f"the environment must return frames of whole numbers or floats in [0, 1] {shape}"
    try:
        given = np.asarray(picture, dtype=np.float32)
    except (TypeError, ValueError):
        raise EnvironmentFault(f"{wanted}, got {type(picture).__name__}") from None
    if given.shape != shape:
        raise EnvironmentFault(f"{wanted}, got shape {given.shape}: declare in observation_space what it returns")
    if not (given.min() >= 0.0 and given.max() <= 1.0):  # also NaN
        remedy = "divide brightness by 255, or declare uint8 within 0 to 255"
        raise EnvironmentFault(f"{wanted}, got {given.dtype} {_describe_range(given)}: {remedy}")
    return np.rint(given * 255.0).astype(np.uint8)


def check_vector(vector: Any, shape: tuple[int, ...]) -> np.ndarray:
    """An observation of numbers, float32 of the shape that its space declares.

    Raises:
        EnvironmentFault: The observation is none of this, or is not finite; the message says what it is.
    """
    wanted = f"the environment must return vectors of finite numbers {shape}"
    try:
        with np.errstate(over="ignore"):
            given = np.array(vector, dtype=np.float32)
    except (TypeError, ValueError):
        raise EnvironmentFault(f"{wanted}, got {shown(vector)}: return an array of numbers") from None
    if given.shape != shape:
        raise EnvironmentFault(f"{wanted}, got shape {given.shape}: declare in observation_space what it returns")
    if not np.isfinite(given).all():
        remedy = "return a finite number at every place"
        raise EnvironmentFault(f"{wanted}, got {given.dtype} {_describe_range(given)}: {remedy}")
    return given


def take_keys(observation: Any, keys: Sequence[str]) -> list[Any]:
    """The values of an observation that is a dictionary, at some of its keys.

    Raises:
        EnvironmentFault: The observation is none, or lacks a key.
    """
    wanted = f"the environment must return observations that are dictionaries with {', '.join(map(repr, keys))}"
    remedy = "return every key that observation_space declares"
    if not isinstance(observation, Mapping):
        raise EnvironmentFault(f"{wanted}, got {type(observation).__name__}: {remedy}")
    for key in keys:
        if key not in observation:
            raise EnvironmentFault(f"{wanted}, got {', '.join(map(repr, observation)) or 'no key'}: {remedy}")
    return [observation[key] for key in keys]


def check_reward(reward: Any) -> float:
    """A reward as a number that is finite in float32, in which replay stores it.

    Raises:
        EnvironmentFault: The reward is no number, or is not finite.
    """
    try:
        value = float(reward)
    except (TypeError, ValueError, OverflowError):
        raise EnvironmentFault(
            f"the environment must return rewards that are numbers, got {shown(reward)}: return one number, such as 0.5"
        ) from None
    with np.errstate(over="ignore"):
        if not np.isfinite(np.float32(value)):
            raise EnvironmentFault(
                f"the environment returned a reward that is not finite: {value}; return a finite number at every step"
            )
    return value


def check_end(end: Any, name: str) -> bool:
    """One of the two ends that a step returns.

    Args:
        end: What the environment returned.
        name: `terminated` or `truncated`.

    Raises:
        EnvironmentFault: The value is not one truth.
    """
    try:
        value = np.asarray(end)
    except Exception:  # arrays of other packages may fail in any way
        value = np.zeros(0)
    if value.size != 1 or value.dtype.kind not in "biu":
        raise EnvironmentFault(
            f"the environment must return {name} as True or False, got {shown(end)}: return bool({name})"
        )
    return bool(value.item())


def check_reset(result: Any, shape: tuple[int, ...]) -> tuple[np.ndarray, dict[str, Any]]:
    """The first frame and the info of an episode, as a reset of an environment has to return them.

    Args:
        result: What the environment returned.
        shape: Shape of a frame.

    Raises:
        EnvironmentFault: The result is something else.
    """
    try:
        frame, info = result
        info = dict(info)
    except (TypeError, ValueError):
        wanted = "the environment's reset must return a frame and an info"
        raise EnvironmentFault(f"{wanted}, got {shown(result)}") from None
    return check_picture(frame, shape), info


def check_step(result: Any, shape: tuple[int, ...]) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
    """Frame, reward, terminated, truncated and info, as a step of an environment has to return them.

    Args:
        result: What the environment returned.
        shape: Shape of a frame.

    Raises:
        EnvironmentFault: The result is something else.
    """
    try:
        frame, reward, terminated, truncated, info = result
        info = {**info, "env_frames": int(info["env_frames"])}
    except (KeyError, TypeError, ValueError):
        raise EnvironmentFault(
            "the environment's step must return a frame, a reward, terminated, truncated and an info with a number "
            f"env_frames, got {shown(result)}"
        ) from None
    ends = check_end(terminated, "terminated"), check_end(truncated, "truncated")
    return check_picture(frame, shape), check_reward(reward), *ends, info


def describe_failure(error: BaseException) -> UserError:
    """The fault that an exception of an environment stands for, with the traceback of the environment's own code.

    A mistake of the user, such as a missing renderer or library, is no fault, because no restart mends it: it is a
    plain `UserError`. The traceback is empty where the mistake shows outside of the environment's own code only.
    """
    if isinstance(error, EnvironmentFault):
        return error
    if isinstance(error, UserError):
        return UserError(str(error))
    if isinstance(error, DependencyNotInstalled | ModuleNotFoundError):
        return UserError(describe_lack(error, "the environment"))
    own = error.__traceback__
    while own is not None and not _is_of_environment(own.tb_frame.f_code.co_filename):
        own = own.tb_next
    origin = "" if own is None else "".join(traceback.format_exception(type(error), error, own))
    reason = cut(str(error)) or "without a message"
    return EnvironmentFault(f"the environment raised {type(error).__name__}: {reason}{_advise(error)}", origin)


def _is_of_environment(file: str) -> bool:
    """Whether a file of code belongs to an environment; some are gymnasium's own, in folders below `envs`."""
    if file.startswith(_GYMNASIUM_ENVS):
        return os.sep in file.removeprefix(_GYMNASIUM_ENVS)
    return not file.startswith(_OWN_FOLDERS)


def describe_lack(error: DependencyNotInstalled | ModuleNotFoundError, user: str) -> str:
    """One line that says which library an environment lacks, and how to install it.

    Args:
        error: What the environment raised; gymnasium says itself how to install what no extra of this package has.
        user: The part that needs the library.
    """
    missing = error if isinstance(error, ModuleNotFoundError) else error.__cause__
    name = missing.name if isinstance(missing, ModuleNotFoundError) else None
    if name is not None and (missing is error or extra_of(name) is not None):
        return describe_missing(name, user)
    return f"{user} needs something that is not installed: {' '.join(str(error).split())}"


def _advise(error: BaseException) -> str:
    """What to do about an error that is known to come from an environment written for another interface."""
    text = str(error)
    if isinstance(error, TypeError) and "unexpected keyword argument" in text and "reset" in text:
        return "; its reset must take both: def reset(self, *, seed=None, options=None)"
    if isinstance(error, TypeError | ValueError) and "unpack" in text:
        return (
            "; reset must return (observation, info), and step (observation, reward, terminated, truncated, info), as "
            "gymnasium.Env describes"
        )
    if isinstance(error, TypeError) and "not a mapping" in text:
        return "; reset and step must return a dict as info"
    return ""


class FrameCheck:
    """Warns once of frames that show nothing: of one colour, or the same for a long time.

    Args:
        num_envs: Number of environments.
    """

    def __init__(self, num_envs: int) -> None:
        self._last: np.ndarray | None = None
        self._num_unchanged = np.zeros(num_envs, np.int64)
        self._num_plain = np.zeros(num_envs, np.int64)
        self._has_warned: set[str] = set()

    def __call__(self, frames: np.ndarray) -> None:
        """Look at the present frames, uint8 (env, height, width, 3)."""
        if self._last is not None and self._last.shape == frames.shape:
            is_same = np.array([np.array_equal(*pair) for pair in zip(frames, self._last, strict=True)])
            self._num_unchanged = np.where(is_same, self._num_unchanged + 1, 0)
        self._last = frames.copy()
        is_plain = np.array([frame.min() == frame.max() for frame in frames])
        self._num_plain = np.where(is_plain, self._num_plain + 1, 0)
        if self._num_plain.max() >= PLAIN_FRAMES:
            colour = "black" if frames[int(self._num_plain.argmax())].max() == 0 else "of one colour"
            self._warn("plain", f"the last {PLAIN_FRAMES} frames of an environment are {colour}")
        elif self._num_unchanged.max() >= UNCHANGED_FRAMES:
            self._warn("unchanged", f"the frames of an environment have not changed for {UNCHANGED_FRAMES} decisions")

    def _warn(self, kind: str, what: str) -> None:
        if kind not in self._has_warned:
            self._has_warned.add(kind)
            warnings.warn(f"{what}: nothing can be learned from them; look at its camera", RuntimeWarning, stacklevel=3)


def _describe_range(values: np.ndarray) -> str:
    if np.issubdtype(values.dtype, np.floating):
        if not np.isfinite(values).all():
            return "with values that are not finite"
        return f"with values {values.min():g} to {values.max():g}"
    return "values"
