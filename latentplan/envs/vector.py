"""Vector environments: several environments with the same settings behind one `step`."""

from __future__ import annotations

import importlib
import itertools
import time
import warnings
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv

from latentplan.config import CollectionConfig, EnvConfig, derive_seed
from latentplan.config.checks import EnvironmentFault
from latentplan.config.env_id import imported_modules, is_by_id
from latentplan.envs.process import CLOSING_SECONDS, Lane, LocalLane, ProcessLane, read_facts
from latentplan.envs.registry import make_env
from latentplan.envs.user import make_from

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence


def make_vector_env(
    config: EnvConfig,
    num_envs: int,
    seed: int | None,
    make_env: Callable[[], gymnasium.Env[Any, Any]] | None = None,
    restarts: Restarts | None = None,
    isolate: bool = False,
    step_timeout_s: float = CollectionConfig.step_timeout_s,
) -> GuardedVectorEnv:
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
        restarts: Counts the restarts of environments that fail; None allows none.
        isolate: Whether a single environment runs in a process of its own too, so that its crash or hang is survived.
        step_timeout_s: Seconds that a reset or a step of an environment in a process of its own may take.

    Returns:
        A gymnasium vector environment: observations uint8 (env, size, size, 3 * camera); rewards, terminated
        and truncated (env,). The entry `labels` of its info holds the labels of each environment and then its
        vectors, (env, number).

    Raises:
        UserError: The environment cannot be built.
        ValueError: There is no environment.
    """
    if num_envs < 1:
        raise ValueError(f"num_envs must be at least 1, got {num_envs}")
    lanes: list[Lane] = []
    for index in range(num_envs):
        factory = EnvMaker(config, _derive_env_seed(seed, index), make_env)
        lanes.append(ProcessLane(factory, step_timeout_s) if isolate or num_envs > 1 else LocalLane(factory))
    return GuardedVectorEnv(lanes, restarts or Restarts(0))


def make_guarded_env(
    config: EnvConfig,
    restarts: Restarts | None = None,
    make_env: Callable[[], gymnasium.Env[Any, Any]] | None = None,
    isolate: bool = False,
    step_timeout_s: float = CollectionConfig.step_timeout_s,
) -> GuardedEnv:
    """One environment that can be made anew after a fault, for evaluations.

    Args:
        config: Settings of the environment.
        restarts: Counts the restarts; None makes no environment anew.
        make_env: See `make_vector_env`.
        isolate: See `make_vector_env`.
        step_timeout_s: See `make_vector_env`.
    """
    factory = EnvMaker(config, 0, make_env)
    return GuardedEnv(ProcessLane(factory, step_timeout_s) if isolate else LocalLane(factory), restarts)


def read_own_facts(env: gymnasium.Env[Any, Any]) -> dict[str, Any]:
    """The attributes of an environment, whether it is guarded or not; see `Lane.facts`."""
    return env.facts if isinstance(env, GuardedEnv) else read_facts(env)


class Restarts:
    """Counts how often environments were made anew, within a budget.

    Attributes:
        count: Restarts so far.

    Args:
        budget: Restarts that are allowed.
    """

    def __init__(self, budget: int) -> None:
        self.budget, self.count = budget, 0

    def spend(self, fault: EnvironmentFault) -> None:
        """Allow one restart because of a fault, and warn of it.

        Raises:
            EnvironmentFault: The budget is spent; the fault has the origin of the one given.
        """
        if self.count >= self.budget:
            often = f"after {self.count} restarts (collection.max_restarts {self.budget})"
            raise EnvironmentFault(f"{fault} {often}", fault.origin)
        self.count += 1
        warnings.warn(
            f"{fault}: its episode is cut short, and it is made anew ({self.count} of {self.budget} restarts)",
            RuntimeWarning,
            stacklevel=4,
        )


class GuardedVectorEnv(VectorEnv[np.ndarray, np.ndarray, Any]):
    """Several environments behind one `step`, each of which is made anew when it fails.

    A fault is an exception, a crash, no answer within a time, or a frame or reward that is not as declared. The step
    that failed truncates the episode: `info["failed"]`, bool (env,), marks the environments, whose frames are those
    before the step and whose rewards are 0. A reset that fails is repeated with another seed, which derives from its
    seed, because an environment may fail with one seed alone.

    Attributes:
        restarts: Counts how often environments were made anew.

    Args:
        lanes: The environments.
        restarts: Counts the restarts of all environments.

    Raises:
        UserError: An environment cannot be made with these settings.
    """

    metadata = {"autoreset_mode": AutoresetMode.DISABLED}

    def __init__(self, lanes: list[Lane], restarts: Restarts) -> None:
        self.lanes, self.restarts, self.num_envs = lanes, restarts, len(lanes)
        try:
            facts = [lane.facts for lane in lanes][0]
        except BaseException:
            self.close_extras(timeout=0.0)
            raise
        self.single_observation_space = facts["observation_space"]
        self.single_action_space = facts["action_space"]
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, self.num_envs)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, self.num_envs)
        shape = self.single_observation_space.shape or ()
        self._frames = np.zeros((self.num_envs, *shape), np.uint8)
        self._labels: list[Any] = [None] * self.num_envs
        self._is_renewed = [False] * self.num_envs  # an environment that was made anew would repeat its first episode

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begins episodes in the environments where `options["reset_mask"]`, bool (env,), is true; without it in all.

        Args:
            seed: Seeds of the environments, or the seed of the first one, from which the others count on; None
                continues their random streams.
            options: See above.

        Returns:
            Frames of all environments, uint8 (env, height, width, 3), and their infos.

        Raises:
            EnvironmentFault: An environment failed more often than the budget of restarts allows.
            ValueError: There is not one seed, or not one value of the mask, for each environment.
        """
        seeds = [int(seed) + index for index in range(self.num_envs)] if isinstance(seed, int | np.integer) else seed
        mask = (options or {}).get("reset_mask", np.ones(self.num_envs, dtype=bool))
        self._check_number("reset_mask", mask)
        if seeds is not None:
            self._check_number("seed", seeds)
        begun = np.flatnonzero(mask).tolist()
        for index in begun:
            self._ask_for_reset(index, seeds)
        given_up: EnvironmentFault | None = None
        for index in begun:  # every answer is taken, also after a fault of another environment
            for attempt in itertools.count(1):  # the budget of restarts ends it
                try:
                    frame, info = self.lanes[index].answer()
                    self._keep(index, frame, info)
                    break
                except EnvironmentFault as fault:
                    try:
                        self._restart(index, fault)
                    except EnvironmentFault as last:
                        given_up = last
                        break
                    self._ask_for_reset(index, seeds, attempt)
        if given_up is not None:
            raise given_up
        return self._frames.copy(), self._info(np.zeros(self.num_envs, np.int64), np.zeros(self.num_envs, bool))

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One step of all environments with actions (env, action); see the class for steps that fail.

        Raises:
            EnvironmentFault: An environment failed more often than the budget of restarts allows.
            ValueError: There is not one action for each environment.
        """
        self._check_number("actions", actions)
        rewards, env_frames = np.zeros(self.num_envs), np.zeros(self.num_envs, np.int64)
        terminated, truncated, failed = (np.zeros(self.num_envs, dtype=bool) for _ in range(3))
        for lane, action in zip(self.lanes, actions, strict=True):
            lane.ask("step", action)
        given_up: EnvironmentFault | None = None
        for index, lane in enumerate(self.lanes):  # every answer is taken, also after a fault of another environment
            try:
                frame, rewards[index], terminated[index], truncated[index], info = lane.answer()
                self._keep(index, frame, info)
                env_frames[index] = info["env_frames"]
            except EnvironmentFault as fault:
                terminated[index], truncated[index], failed[index], rewards[index] = False, True, True, 0.0
                try:
                    self._restart(index, fault)
                except EnvironmentFault as last:
                    given_up = last
        if given_up is not None:
            raise given_up
        return self._frames.copy(), rewards, terminated, truncated, self._info(env_frames, failed)

    def close_extras(self, timeout: float | None = None, **_: Any) -> None:
        """Ends the environments, those that hang after `timeout` seconds; `close` calls this method once."""
        end = time.monotonic() + (CLOSING_SECONDS if timeout is None else timeout)
        for lane in self.lanes:
            lane.ask_to_close()
        for lane in self.lanes:
            lane.close(max(0.0, end - time.monotonic()))

    def _check_number(self, name: str, values: Any) -> None:
        """Raises ValueError, before any environment is asked, unless there is one value for each environment."""
        shape = np.shape(values)
        if shape[:1] != (self.num_envs,):
            raise ValueError(f"{name} must have one entry for each of {self.num_envs} environments, got shape {shape}")

    def _ask_for_reset(self, index: int, seeds: Sequence[int | None] | None, attempt: int = 0) -> None:
        seed = None if seeds is None else seeds[index]
        if seed is None and self._is_renewed[index]:
            seed = derive_seed(self.restarts.count, "restart", index)
        elif seed is not None and attempt > 0:
            seed = derive_seed(seed, "reset", attempt)
        self._is_renewed[index] = False
        self.lanes[index].ask("reset", seed=seed)

    def _restart(self, index: int, fault: EnvironmentFault) -> None:
        self.restarts.spend(fault)
        self._is_renewed[index] = True
        self.lanes[index].restart()

    def _keep(self, index: int, frame: Any, info: dict[str, Any]) -> None:
        self._frames[index] = frame
        known = [info[name] for name in ("labels", "vectors") if info.get(name) is not None]
        self._labels[index] = np.concatenate(known) if known else None

    def _info(self, env_frames: np.ndarray, failed: np.ndarray) -> dict[str, Any]:
        info: dict[str, Any] = {"env_frames": env_frames, "failed": failed}
        if all(labels is not None for labels in self._labels):
            info["labels"] = np.stack(self._labels)
        return info


class GuardedEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One environment whose faults are raised as `EnvironmentFault`, and that is then made anew within a budget.

    The first look at its spaces, metadata or `facts` waits for the environment's process.

    Args:
        lane: The environment.
        restarts: Counts the restarts; None makes no environment anew.
    """

    def __init__(self, lane: Lane, restarts: Restarts | None) -> None:
        self._lane, self._restarts = lane, restarts

    @property
    def facts(self) -> dict[str, Any]:
        """Attributes of the environment; see `Lane.facts`."""
        return self._lane.facts

    @property
    def observation_space(self) -> Any:  # type: ignore[override]
        """The environment's own."""
        return self.facts["observation_space"]

    @property
    def action_space(self) -> Any:  # type: ignore[override]
        """The environment's own."""
        return self.facts["action_space"]

    @property
    def decisions_per_episode(self) -> int | None:
        """Decisions until the environment's time limit; None without one."""
        return self.facts["decisions_per_episode"]  # type: ignore[no-any-return]

    @property
    def metadata(self) -> dict[str, Any]:  # type: ignore[override]
        """The environment's own."""
        return self.facts["metadata"]  # type: ignore[no-any-return]

    @property
    def render_large(self) -> Callable[[int], Any]:
        """See the environment's own `render_large`, where it has one."""
        if not self.facts["can_render_large"]:
            raise AttributeError("the environment draws no larger pictures")
        return partial(self._call, "render_large")

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """See the environment's own `reset`."""
        return self._call("reset", seed=seed, options=options)  # type: ignore[no-any-return]

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """See the environment's own `step`."""
        return self._call("step", action)  # type: ignore[no-any-return]

    def render(self) -> Any:
        """See the environment's own `render`."""
        return self._call("render")

    def close(self) -> None:
        """Ends the environment."""
        self._lane.ask_to_close()
        self._lane.close()

    def _call(self, method: str, *arguments: Any, **named: Any) -> Any:
        """The result of a method; after a fault the environment is made anew before the fault is raised."""
        self._lane.ask(method, *arguments, **named)
        try:
            return self._lane.answer()
        except EnvironmentFault as fault:
            if self._restarts is not None:
                self._restarts.spend(fault)
                self._lane.restart()
            raise


@dataclass(frozen=True)
class EnvMaker:
    """Makes one environment in the process that calls it, from its settings or by the user's factory.

    The object is picklable where the user's factory is. It takes along the module that registers the environment, if
    the present process has imported it, and imports it in the other process.

    Attributes:
        config: Settings of the environment.
        seed: Seed of the first reset.
        factory: The user's factory, or None.
        modules: Modules to import first.
    """

    config: EnvConfig
    seed: int | None
    factory: Callable[[], gymnasium.Env[Any, Any]] | None = None
    modules: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "modules", imported_modules(self.config))

    def __call__(self) -> gymnasium.Env[np.ndarray, np.ndarray]:
        """The environment."""
        for module in self.modules:
            importlib.import_module(module)
        build = make_env if self.factory is None else make_from(self.factory)
        env: gymnasium.Env[np.ndarray, np.ndarray] = build(self.config, self.seed)
        return _WithoutInfo(env) if self.factory is not None or is_by_id(self.config) else env


class _WithoutInfo(gymnasium.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray]):
    """A user's environment without infos of its own, because their entries may not fit into one array."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        frame, info = self.env.reset(seed=seed, options=options)
        return frame, _known(info)

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        frame, reward, terminated, truncated, info = self.env.step(action)
        return frame, reward, terminated, truncated, _known(info)


def _known(info: dict[str, Any]) -> dict[str, Any]:
    return {name: info[name] for name in ("env_frames", "vectors") if name in info}


def _derive_env_seed(seed: int | None, index: int) -> int | None:
    return None if seed is None else int(np.random.SeedSequence([seed, index]).generate_state(1)[0])
