"""The pictures that an environment draws, in place of the pictures of its observations."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from typing import Any

import gymnasium
import numpy as np

from latentplan.config import EnvConfig, UserError
from latentplan.config.checks import EnvironmentFault
from latentplan.envs.faults import describe_failure, take_keys
from latentplan.envs.spaces import ONLY_PICTURE, find_vector, resize

MODE = "rgb_array"
TIMED_PICTURES = 5


def time_pictures(env: Any, config: EnvConfig) -> float:
    """Milliseconds in which an environment draws a picture of its present state; after a reset."""
    draw = partial(env.render_large, config.frame_size) if config.pixels == "render" else env.render
    started = time.perf_counter()
    for _ in range(TIMED_PICTURES):
        draw()
    return 1e3 * (time.perf_counter() - started) / TIMED_PICTURES


def draw(env: gymnasium.Env[Any, Any]) -> np.ndarray:
    """The picture that an environment's `render()` draws of its present state, uint8 (height, width, 3).

    Raises:
        EnvironmentFault: `render()` failed, or returned anything but such a picture.
        UserError: `render()` needs something that is not installed.
    """
    try:
        given: Any = env.render()
        picture = np.asarray(given)
    except Exception as error:
        raise describe_failure(error) from error
    if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3 or 0 in picture.shape:
        what = type(given).__name__ if picture.dtype == object else f"{picture.dtype} {picture.shape}"
        raise EnvironmentFault(
            f"render() must return pictures uint8 (height, width, 3), got {what}: correct the environment's render"
        )
    return picture


class RenderedEnv(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment whose observations are the pictures of its `render()`, uint8 (size, size, 3).

    With vectors the observations are a Dict of this picture, named `picture`, and of these entries of the environment's
    own observations.

    A rectangular picture is squeezed to the square, so that nothing at its sides is cut off. A picture is drawn when it
    is read: steps between two decisions draw none.

    Args:
        env: An environment with the render mode `rgb_array`.
        size: Height and width of the pictures, in pixels.
        vectors: Keys of the environment's own observations, which are a Dict with Boxes of numbers at these keys.

    Raises:
        UserError: The environment has another render mode, or no numbers at a key.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], size: int, vectors: Sequence[str] = ()) -> None:
        if env.render_mode != MODE:
            raise UserError(
                f"env.pixels render needs an environment that is made with render_mode='{MODE}', got "
                f"{env.render_mode!r} of {env.metadata.get('render_modes', [])}: give it a render() that returns uint8 "
                "pictures (height, width, 3)"
            )
        if ONLY_PICTURE in vectors:
            raise UserError(
                f"env.vectors cannot name {ONLY_PICTURE!r} with env.pixels render, whose picture has this name: rename "
                "this entry of the environment's observations"
            )
        super().__init__(env)
        self.size, self._vectors = size, list(vectors)
        picture = gymnasium.spaces.Box(0, 255, (size, size, 3), np.uint8)
        parts = {key: find_vector(env.observation_space, key) for key in vectors}
        self.observation_space = gymnasium.spaces.Dict({**parts, ONLY_PICTURE: picture}) if vectors else picture

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begins an episode; of the environment's own observation the vectors alone are kept."""
        observation, info = self.env.reset(seed=seed, options=options)
        return self._replace(observation), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Steps the environment; of its own observation the vectors alone are kept."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._replace(observation), reward, terminated, truncated, info

    def _replace(self, observation: Any) -> Any:
        """The picture in place of an observation, with its vectors if there are any."""
        picture = _Picture(self)
        if not self._vectors:
            return picture
        vectors = zip(self._vectors, take_keys(observation, self._vectors), strict=True)
        return {**dict(vectors), ONLY_PICTURE: picture}


class _Picture:
    """The picture of an environment's present state, drawn when it becomes an array."""

    def __init__(self, env: RenderedEnv) -> None:
        self._env = env

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return resize(draw(self._env.env), self._env.size)
