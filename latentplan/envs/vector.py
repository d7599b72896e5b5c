"""Vector environments: several environments with the same settings behind one `step`."""

from __future__ import annotations

import multiprocessing
import os
import signal
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.wrappers import TimeLimit

from latentplan.config import EnvConfig
from latentplan.envs.registry import make_env
from latentplan.envs.user import make_from

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

_THREAD_SETTINGS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def make_vector_env(
    config: EnvConfig,
    num_envs: int,
    seed: int | None,
    make_env: Callable[[], gymnasium.Env[Any, Any]] | None = None,
    episode_decisions: int | None = None,
) -> VectorEnv[np.ndarray, np.ndarray, Any]:
    """Several environments behind one `step`; two or more environments run in separate processes.

    Finished episodes do not restart by themselves, so `step` always returns the result of its own action. Restart
    finished environments with `vector_env.reset(options={"reset_mask": ended})`, where `ended` is a bool array
    (env,); the observations of the other environments come back unchanged. Processes are spawned, because a forked
    child hangs once an OpenGL context exists.

    Args:
        config: Settings of every environment.
        num_envs: Number of environments.
        seed: The seed of each environment is derived from this seed and the environment's index; None draws seeds from
            the system.
        make_env: A user's factory, called in each process instead of the suite's; it must be picklable.
        episode_decisions: Decisions after which an episode is truncated; None leaves the length to the task.

    Returns:
        A gymnasium vector environment: observations uint8 (env, 64, 64, 3); rewards, terminated and truncated (env,).

    Raises:
        UserError: The environment cannot be built.
    """
    factories = [
        _EnvFactory(config, _derive_env_seed(seed, index), make_env, episode_decisions) for index in range(num_envs)
    ]
    if num_envs == 1:
        return SyncVectorEnv(factories, autoreset_mode=AutoresetMode.DISABLED)
    with single_threaded_children():
        return AsyncVectorEnv(factories, shared_memory=True, context="spawn", autoreset_mode=AutoresetMode.DISABLED)


@dataclass(frozen=True)
class _EnvFactory:
    """Builds one environment in the process that calls it; picklable where the user's factory is."""

    config: EnvConfig
    seed: int | None
    factory: Callable[[], gymnasium.Env[Any, Any]] | None
    episode_decisions: int | None

    def __call__(self) -> gymnasium.Env[np.ndarray, np.ndarray]:
        if multiprocessing.parent_process() is not None:
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the parent handles it
        build = make_env if self.factory is None else make_from(self.factory)
        env: gymnasium.Env[np.ndarray, np.ndarray] = build(self.config, self.seed)
        env = env if self.factory is None else _WithoutInfo(env)
        return env if self.episode_decisions is None else TimeLimit(env, self.episode_decisions)


class _WithoutInfo(gymnasium.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray]):
    """A user's environment with `env_frames` as its only info, because other entries may not fit into one array."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        frame, info = self.env.reset(seed=seed, options=options)
        return frame, {"env_frames": info["env_frames"]}

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        frame, reward, terminated, truncated, info = self.env.step(action)
        return frame, reward, terminated, truncated, {"env_frames": info["env_frames"]}


def _derive_env_seed(seed: int | None, index: int) -> int | None:
    return None if seed is None else int(np.random.SeedSequence([seed, index]).generate_state(1)[0])


@contextmanager
def single_threaded_children() -> Iterator[None]:
    """Limits processes that start inside the `with` block to one thread, by environment variables."""
    before = {name: os.environ.get(name) for name in _THREAD_SETTINGS}
    os.environ.update(dict.fromkeys(_THREAD_SETTINGS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
