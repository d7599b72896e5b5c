"""A user's own environment, adapted to the frames and actions of an agent."""

from __future__ import annotations

import math
import warnings
import weakref
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded

from latentplan.config import EnvConfig, UserError
from latentplan.envs.faults import check_end, check_reward
from latentplan.envs.rendered import MODE, RenderedEnv, draw
from latentplan.envs.spaces import Actions, Interface, Observations, accept_spaces, resize

if TYPE_CHECKING:
    from collections.abc import Callable


_made: weakref.WeakValueDictionary[int, gymnasium.Env[Any, Any]] = weakref.WeakValueDictionary()  # by users' factories
MAX_DECISIONS = 1000  # decisions of an episode without a time limit, as in the longest episodes of dm_control


def make_from(
    factory: Callable[[], gymnasium.Env[Any, Any]],
) -> Callable[[EnvConfig, int | None], PixelEnv]:
    """A function with the signature of `make_env` that builds a user's environments.

    The function reads `action_repeat`, `pixels`, `frame_size`, `cameras` and `vectors` of the settings, and raises
    `UserError` where the factory returns no `gymnasium.Env` or an environment that `wrap_user_env` refuses.

    Args:
        factory: Returns a new environment with spaces that `accept_spaces` accepts.
    """

    def build(config: EnvConfig, seed: int | None = None) -> PixelEnv:
        env = factory()
        _require_env(env, "make_env must return")
        if _made.get(id(env)) is env:
            raise UserError(
                "make_env must return a new environment at each call, and returned the same one twice: episodes of "
                "evaluation and collection would mix"
            )
        _made[id(env)] = env
        return wrap_user_env(env, config.action_repeat, seed, config=config)

    return build


def wrap_user_env(
    env: gymnasium.Env[Any, Any], action_repeat: int = 1, seed: int | None = None, *, config: EnvConfig | None = None
) -> PixelEnv:
    """A user's environment with the interface for agents: frames of 64 x 64, actions in [-1, 1], action repeat.

    Args:
        env: A gymnasium environment. `env.observation_space` is a picture of any size (see
            `latentplan.envs.spaces.Picture`), or a Dict of pictures, one for each camera; larger images are averaged
            down, smaller images are interpolated. `env.action_space` is a bounded Box
            of any shape, Discrete, MultiDiscrete, MultiBinary, or a Dict or Tuple of them.
        action_repeat: Steps of `env` per decision, at least 1; a step of the result repeats the action for this number
            of steps of `env`, or until the episode ends, and sums the rewards.
        seed: Seed of the first reset that is called without one; None draws a seed from the system.
        config: Size of the frames, names of cameras and vectors, such as `agent.config.env`; None takes the defaults.
            Its `action_repeat` is not read.
            With `pixels` "render" the frames are what `env.render()` draws, which needs `env.render_mode` "rgb_array",
            and the observations may be anything, or a Dict with the vectors that `vectors` names.

    Returns:
        An environment with these properties:

        - Observations are uint8 (64, 64, 3), each a new array. Another `frame_size` and several cameras, which lie side
          by side along the last axis, change this shape.
        - Actions are float32 (action,) in [-1, 1], all numbers of `env.action_space` side by side; values outside are
          clipped. The interval is mapped linearly to the bounds of a Box. A choice of n categories is one number: the
          interval has n equal parts, one for each category.
        - `info["vectors"]` holds the numbers that `config.vectors` names, float32 (vector,), if it names any.
        - `info["env_frames"]` of a step is the number of steps of `env` that it took; `info` of `env` is kept but for
          entries `labels` and `vectors`, which are names of the program.
        - An environment without a time limit is truncated after 1000 decisions.
        - `step` raises `ResetNeeded` after the end of an episode, and `ValueError` for an action of another shape or
          with numbers that are not finite.

    Raises:
        UserError: `env` is no `gymnasium.Env`, `action_repeat` is below 1, or a space is not as described; the message
            names the space and the reason and the remedy.
    """
    _require_env(env, "wrap_user_env takes")
    config = config or EnvConfig()
    if config.pixels == "render":
        if config.cameras:
            raise UserError(
                "env.cameras has no effect with env.pixels render, which shows the one picture that render() draws: "
                "leave env.cameras out"
            )
        env = RenderedEnv(env, config.frame_size, config.vectors)
    refuse_spaces(env, config)
    return PixelEnv(env, action_repeat, seed, config)


class PixelEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """An image environment with frames of 64 x 64, actions in [-1, 1] and action repeat; see `wrap_user_env`.

    Attributes:
        action_repeat: Steps of the inner environment per decision; rewards are summed over them.
        decisions_per_episode: Decisions until the time limit of the environment's spec or of a `TimeLimit` wrapper.
            None without a time limit; then an episode is truncated after `MAX_DECISIONS` decisions.
        spaces: What the networks have to know of actions and observations.
        interface: What the inner environment shows and takes.
    """

    metadata = {"render_modes": ["rgb_array"]}
    render_mode = "rgb_array"

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        action_repeat: int,
        seed: int | None = None,
        config: EnvConfig | None = None,
    ) -> None:
        """Checks the spaces; see `wrap_user_env`."""
        if action_repeat % 1 or action_repeat < 1:
            raise UserError(f"action_repeat must be a whole number of at least 1, got {action_repeat}")
        accepted = accept_spaces(env.observation_space, env.action_space, config)
        self._observations, self._actions, self.spaces = accepted.observations, accepted.actions, accepted.spaces
        self.interface = Interface(self._observations.pictures, self._observations.vectors, env.action_space)
        self._env = env
        self._first_seed = seed
        self._picture = np.zeros((self.spaces.frame_size, self.spaces.frame_size, 3), dtype=np.uint8)
        self._needs_reset = True
        self._decisions = 0
        self.action_repeat = action_repeat
        limit: Any = env.spec.max_episode_steps if env.spec is not None else None
        if limit is None and env.has_wrapper_attr("_max_episode_steps"):  # a `TimeLimit` without a spec
            limit = env.get_wrapper_attr("_max_episode_steps")
        if limit is not None and not 1 <= limit < math.inf:
            limit = None
        if rate := env.metadata.get("render_fps"):
            self.metadata = {**PixelEnv.metadata, "render_fps": rate / action_repeat}
        self.decisions_per_episode = None if limit is None else math.ceil(limit / action_repeat)
        self.observation_space = gymnasium.spaces.Box(0, 255, self.spaces.frame_shape, np.uint8)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (self._actions.dim,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begins an episode; returns the first frame and the inner environment's info."""
        seed, self._first_seed = self._first_seed if seed is None else seed, None
        super().reset(seed=seed)
        picture, info = self._env.reset(seed=seed, options=options)
        self._needs_reset, self._decisions = False, 0
        return self._to_frame(picture), self._to_info(info, picture, 0)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Holds an action (action,) in [-1, 1] for `action_repeat` steps of the inner environment.

        Returns:
            Frame (size, size, 3 * camera), summed reward, terminated, truncated, info.

        Raises:
            ResetNeeded: The episode is over.
            ValueError: The action has another shape or is not finite.
            EnvironmentFault: A frame or a reward of the inner environment is not as its spaces declare, or an end is
                not one truth.
        """
        if self._needs_reset:
            raise ResetNeeded("the episode is over; call reset() first")
        self._check_action(action)
        total, env_frames, terminated, truncated = 0.0, 0, False, False
        while env_frames < self.action_repeat and not (terminated or truncated):
            # A new value for each step, because the environment may change it in place.
            picture, reward, terminated, truncated, info = self._env.step(self._actions.value(action))
            total += check_reward(reward)
            terminated, truncated = check_end(terminated, "terminated"), check_end(truncated, "truncated")
            env_frames += 1
        self._decisions += 1
        truncated = truncated or self._decisions >= (self.decisions_per_episode or MAX_DECISIONS)
        self._needs_reset = terminated or truncated
        return self._to_frame(picture), total, terminated, truncated, self._to_info(info, picture, env_frames)

    def inner_action(self, action: np.ndarray) -> Any:
        """The value of the inner environment's action space for an agent's action (action,) in [-1, 1].

        Raises:
            ValueError: The action has another shape or is not finite.
        """
        self._check_action(action)
        return self._actions.value(action)

    def _check_action(self, action: np.ndarray) -> None:
        if np.shape(action) != self.action_space.shape or not np.isfinite(action).all():
            raise ValueError(f"the action must be {self.action_space.shape} finite numbers, got {action!r}")

    def render(self) -> np.ndarray:  # type: ignore[override]
        """The first camera's last picture, a new uint8 array (size, size, 3)."""
        return resize(self._picture, self.spaces.frame_size)

    def render_large(self, size: int) -> np.ndarray:
        """The inner environment's rendering where it has one, else its last observation, uint8 (size, size, 3).

        A rendering that fails or is no picture uint8 (height, width, 3) gives a warning, and the last observation.
        """
        if self._env.render_mode == MODE:
            try:
                return resize(draw(self._env), size)
            except UserError as error:
                warnings.warn(f"{error}; films show observations instead", RuntimeWarning, stacklevel=2)
        return resize(self._picture, size)

    def close(self) -> None:
        """Closes the inner environment."""
        self._env.close()

    def _to_info(self, info: dict[str, Any], observation: Any, env_frames: int) -> dict[str, Any]:
        """The inner environment's info, without entries of its own that have names of the program."""
        kept = {name: value for name, value in {**info}.items() if name not in ("labels", "vectors")}
        vectors = {"vectors": self._observations.read_vectors(observation)} if self.spaces.vector_dim else {}
        return {**kept, **vectors, "env_frames": env_frames}

    def _to_frame(self, observation: Any) -> np.ndarray:
        frame, self._picture = self._observations.read(observation)
        return frame


def _require_env(env: Any, where: str) -> None:
    if not isinstance(env, gymnasium.Env):
        raise UserError(
            f"{where} a gymnasium.Env, got {type(env).__name__}: give one environment whose class derives from "
            "gymnasium.Env (the package shimmy converts environments of gym and dm_env)"
        )


def describe_refusals(env: gymnasium.Env[Any, Any], config: EnvConfig | None = None) -> list[str]:
    """One line for each space that an environment lacks or agents cannot learn with, with its remedy; may be empty.

    Args:
        env: The environment.
        config: Size of the frames, names of cameras and vectors; None takes the defaults.
    """
    missing = [name for name in ("observation_space", "action_space") if getattr(env, name, None) is None]
    if missing:
        advice = "set it in __init__ or in the class, as gymnasium.Env describes"
        return [f"the environment has no {name}: {advice}" for name in missing]
    config, problems = config or EnvConfig(), []
    try:
        Observations(env.observation_space, config.frame_size, config.cameras, config.vectors)
    except UserError as error:
        can_render = config.pixels != "render" and MODE in env.metadata.get("render_modes", ())
        shows = f"; --env.pixels render takes what its render() draws instead (render_mode '{MODE}')"
        problems.append(f"{error}{shows if can_render else ''}")
    try:
        Actions(env.action_space)
    except UserError as error:
        problems.append(str(error))
    return problems


def refuse_spaces(env: gymnasium.Env[Any, Any], config: EnvConfig) -> None:
    """Refuses an environment that agents cannot learn in.

    Raises:
        UserError: See `describe_refusals`.
    """
    problems = describe_refusals(env, config)
    if problems:
        raise UserError("; ".join(problems))
