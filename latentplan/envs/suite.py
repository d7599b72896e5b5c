"""The suite `dm_control`: every task of `dm_control.suite` as a gymnasium environment of camera frames."""

from __future__ import annotations

import logging
import math
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded

from latentplan.config import EnvConfig, UserError
from latentplan.config.checks import shown
from latentplan.config.quantities import scales
from latentplan.config.spaces import Spaces
from latentplan.envs.gl import explain_gl_errors, require_backend
from latentplan.envs.registry import default_task
from latentplan.envs.render import FrameRenderer, draw_floor_behind
from latentplan.envs.spaces import Interface
from latentplan.envs.substeps import control_step, split_schedule
from latentplan.envs.true_quantities import ObjectiveReward, measure, true_values

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from dm_control.mujoco import Physics

PROPRIOCEPTION = "proprioception"  # in `EnvConfig.vectors`: all parts of a task's observation
_UNLIMITED_EPISODE_STEPS = 1000


class SuiteEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """A task of `dm_control.suite` with frames as observations, bounded actions and action repeat.

    An observation is a uint8 frame (size, size, 3 * camera), always a new array. An action is float32 (action,) in
    [-1, 1], scaled to the actuators' range. `reset(seed=s)` depends on s alone; `reset()` continues the random
    stream. The time limit
    truncates an episode; only the task terminates an episode. `info["env_frames"]` is the number of control steps that
    a step took, which is smaller than the action repeat where an episode ends early. `info["labels"]` holds the true
    quantities at the frame, float32 (label,).

    Attributes:
        action_repeat: Control steps per decision; rewards are summed over them.
        decisions_per_episode: Decisions until the time limit.
        domain: Domain of the suite.
        record_quantities: Whether the `info` of a step holds the true values after each of its control steps:
            `quantities`, float64 (control step, quantity) in the order of `scales(domain)`, and `rewards`, float64
            (control step,).
        spaces: What the networks have to know of actions and observations.
        interface: Ids of the cameras, names of the vectors, and the actuators' range.
        labels: Names of the quantities in `info["labels"]`, each with its scale.
        substeps_per_decision: Steps of the simulator per decision: the finest resolution at which actions change.
    """

    metadata = {"render_modes": ["rgb_array"]}
    render_mode = "rgb_array"

    def __init__(self, config: EnvConfig, seed: int | None = None) -> None:
        """Loads the task; the OpenGL context is made with the first frame.

        Args:
            config: Domain, task, action repeat, camera and render quality.
            seed: Seed of the random stream; None draws a seed from the system.

        Raises:
            UserError: The domain, task or camera does not exist, no OpenGL library can render, or the objective is no
                expression.
        """
        self._objective = None if config.objective is None else ObjectiveReward(config.objective, config.domain)
        task = default_task(config.domain) if config.task is None else config.task
        self._task_env = _load_task(config.domain, task)
        self._cameras = _check_cameras(self.physics, config)
        self._frame_size = config.frame_size
        self._vectors = config.vectors
        vectors = tuple((name, len(self._measure_vectors((name,)))) for name in self._vectors)
        vector_dim = sum(size for _, size in vectors)
        self.spaces = Spaces(frame_size=config.frame_size, cameras=len(self._cameras), vector_dim=vector_dim)
        if config.floor == "endless":
            draw_floor_behind(self.physics)
        self.domain = config.domain
        self._quality, self._slices = config.render_quality, config.render_slices
        self.labels = scales(config.domain)
        self._renderers: dict[tuple[int, int], FrameRenderer] = {}
        self._needs_reset = True
        self._steps_left = 0
        # An episode lasts for the first whole number of steps that reaches dm_control's limit.
        limit = self._task_env._step_limit
        self._steps_per_episode = _UNLIMITED_EPISODE_STEPS if math.isinf(limit) else math.ceil(limit)
        self.record_quantities = False
        self._recorded: list[tuple[np.ndarray, float]] = []
        self.action_repeat = config.action_repeat
        self.substeps_per_decision = config.action_repeat * self._task_env._n_sub_steps
        frames_per_second = 1.0 / (self._task_env.control_timestep() * config.action_repeat)
        self.metadata = {**SuiteEnv.metadata, "render_fps": frames_per_second}
        self.decisions_per_episode = math.ceil(self._steps_per_episode / config.action_repeat)
        spec = self._task_env.action_spec()
        bounded = self.physics.model.actuator_ctrllimited.astype(bool)
        self._action_low = np.where(bounded, spec.minimum, -1.0)
        self._action_high = np.where(bounded, spec.maximum, 1.0)
        self.observation_space = gymnasium.spaces.Box(0, 255, self.spaces.frame_shape, np.uint8)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, spec.shape, np.float32)
        own = gymnasium.spaces.Box(self._action_low, self._action_high, dtype=np.float64)
        self.interface = Interface(tuple(map(str, self._cameras)), vectors, own)
        self._seed_task(seed)

    @property
    def physics(self) -> Physics:
        """The simulated body, to read the true state from."""
        return self._task_env.physics

    def true_state(self) -> np.ndarray:
        """Positions, velocities and activations of the body, float64 (state,)."""
        return self.physics.get_state()

    @property
    def pushed_body(self) -> str:
        """Name of the body that `push` pushes: the first one that can move, such as the torso."""
        return str(self.physics.model.id2name(self._find_root(), "body"))

    @property
    def weight(self) -> float:
        """Weight of everything that moves with that body, in newtons."""
        model = self.physics.model
        return float(model.body_subtreemass[self._find_root()] * np.linalg.norm(model.opt.gravity))

    def push(self, force: Sequence[float]) -> None:
        """Applies a force to the middle of the first body that can move, until the next call or reset.

        Args:
            force: The force in newtons, along the axes of the world, (3,); zeros end the push.
        """
        self.physics.data.xfrc_applied[self._find_root(), :3] = force

    def _find_root(self) -> int:
        """The first body with a joint."""
        return int(np.flatnonzero(self.physics.model.body_dofnum)[0])

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begins an episode.

        Args:
            seed: Seed that restarts the random stream; None continues the stream.
            options: Not used.

        Returns:
            The first frame (size, size, 3 * camera), and an info with `env_frames` 0 and the first labels.
        """
        super().reset(seed=seed)
        if seed is not None:
            self._seed_task(seed)
        self._task_env.reset()
        for renderer in self._renderers.values():
            renderer.refresh_terrain()
        self._steps_left = self._steps_per_episode
        self._needs_reset = False
        return self._observe(), self._info(0)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Holds an action for `action_repeat` control steps.

        Args:
            action: The action, (action,), clipped to [-1, 1].

        Returns:
            Frame (size, size, 3 * camera), summed reward, terminated, truncated, info.

        Raises:
            ResetNeeded: The episode is over.
            ValueError: The action has another shape or is not finite.
        """
        return self.step_schedule([(action, self.substeps_per_decision)])

    def step_schedule(
        self, schedule: Sequence[tuple[np.ndarray, int]]
    ) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One decision during which the action changes at given substeps of the simulator.

        Args:
            schedule: Actions (action,), clipped to [-1, 1], and their numbers of substeps, which add up to
                `substeps_per_decision`.

        Returns:
            As `step`: frame, summed reward, terminated, truncated, info.

        Raises:
            ResetNeeded: The episode is over.
            ValueError: An action has another shape or is not finite, or the substeps do not add up.
        """
        if self._needs_reset:
            raise ResetNeeded("the episode is over; call reset() first")
        counts = [count for _, count in schedule]
        if min(counts, default=0) < 1 or sum(counts) != self.substeps_per_decision:
            raise ValueError(f"substeps must be positive and add up to {self.substeps_per_decision}, got {counts}")
        controls = [(self._scale_action(action), count) for action, count in schedule]
        reward, env_frames, terminated = 0.0, 0, False
        for control in split_schedule(controls, self._task_env._n_sub_steps):
            outcome = control_step(self._task_env, control)
            reward += self._control_step_reward(float(outcome.reward))
            env_frames += 1
            self._steps_left -= 1
            # dm_control marks the end by the task with discount 0, and the time limit with discount 1.
            terminated = outcome.last() and outcome.discount == 0.0
            self._needs_reset = outcome.last() or self._steps_left <= 0
            if self._needs_reset:
                break
        return self._observe(), reward, terminated, self._needs_reset and not terminated, self._info(env_frames)

    def render(self) -> np.ndarray:  # type: ignore[override]
        """The first camera's picture of the present state, a new uint8 array (size, size, 3)."""
        return self.render_large(self._frame_size)

    def render_large(self, size: int) -> np.ndarray:
        """The present state through the first camera at another resolution, a new uint8 array (size, size, 3)."""
        return self._draw(size, self._cameras[0])

    def _draw(self, size: int, camera: int) -> np.ndarray:
        if (size, camera) not in self._renderers:
            slices = self._slices if size == self._frame_size else None  # a film is to look smooth
            self._renderers[size, camera] = FrameRenderer(self.physics, size, camera, self._quality, slices)
        return self._renderers[size, camera].render()

    def _observe(self) -> np.ndarray:
        """The agent's frame of the present state, a new uint8 array (size, size, 3 * camera)."""
        pictures = [self._draw(self._frame_size, camera) for camera in self._cameras]
        return pictures[0] if len(pictures) == 1 else np.concatenate(pictures, axis=2)

    def close(self) -> None:
        """Frees OpenGL contexts and simulator; the environment cannot be used afterwards."""
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()
        self.physics.free()
        self._needs_reset = True

    def _info(self, env_frames: int) -> dict[str, Any]:
        info = {"env_frames": env_frames, "labels": measure(self.domain, self.physics)}
        if self._vectors:
            info["vectors"] = self._measure_vectors(self._vectors)
        if self._recorded:
            quantities, rewards = zip(*self._recorded, strict=True)
            info |= {"quantities": np.stack(quantities), "rewards": np.array(rewards)}
            self._recorded.clear()
        return info

    def _measure_vectors(self, names: Sequence[str]) -> np.ndarray:
        """Parts of the task's observation, float32 (number,).

        Raises:
            UserError: The task's observation has no such part.
        """
        observed = self._task_env.task.get_observation(self.physics)
        known = {**observed, PROPRIOCEPTION: np.concatenate([np.ravel(value) for value in observed.values()])}
        for name in names:
            if name not in known:
                raise UserError(f"env.vectors names {shown(name)}; the task has {', '.join(known)}")
        return np.concatenate([np.ravel(known[name]) for name in names]).astype(np.float32)

    def _control_step_reward(self, reward: float) -> float:
        """The reward of the latest control step; also recorded, with the quantities, if `record_quantities` is set.

        Args:
            reward: The task's own reward, which an objective replaces.
        """
        if self._objective is None and not self.record_quantities:
            return reward
        values = true_values(self.domain, self.physics)
        if self._objective is not None:
            reward = self._objective(values)
        if self.record_quantities:
            self._recorded.append((values, reward))
        return reward

    def _seed_task(self, seed: int | None) -> None:
        self._task_env.task.random.seed(seed)

    def _scale_action(self, action: np.ndarray) -> np.ndarray:
        """The action (action,), clipped to [-1, 1] and scaled to the actuators' range, float64.

        Raises:
            ValueError: The action has another shape or is not finite.
        """
        action = np.asarray(action, dtype=np.float64)
        if action.shape != self.action_space.shape:
            raise ValueError(f"action has shape {action.shape}, the environment takes {self.action_space.shape}")
        if not np.isfinite(action).all():
            raise ValueError(f"action must be finite, got {action}")
        return self._action_low + (np.clip(action, -1.0, 1.0) + 1.0) * 0.5 * (self._action_high - self._action_low)


def _load_task(domain: str, task: str) -> Any:
    require_backend()
    with explain_gl_errors():
        from dm_control import suite
    with _quiet_model_compiler():
        # A few tasks draw their body at random when they are built: a fixed seed gives the same body every time.
        return suite.load(domain, task, task_kwargs={"random": 0})


@contextmanager
def _quiet_model_compiler() -> Iterator[None]:
    """Hides warnings about the suite's model files, which users cannot change."""
    logger = logging.getLogger("absl")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)


def _check_cameras(physics: Physics, config: EnvConfig) -> list[int]:
    """The ids of the cameras that the settings name.

    Raises:
        UserError: One of them does not exist.
    """
    count = physics.model.ncam
    for name in config.cameras:
        if not name.isdecimal():
            raise UserError(f"--env.cameras takes camera ids of {config.domain}, 0 to {count - 1}, got {shown(name)}")
    cameras = [int(name) for name in config.cameras] or [config.camera]
    for camera in cameras:
        if camera >= count:
            raise UserError(f"camera {camera} does not exist; {config.domain} has {count} cameras")
    return cameras
