"""Workers that are actors of a Ray cluster; Ray is imported when the first of them is asked for."""

from __future__ import annotations

import contextlib
import importlib
import os
import time
import warnings
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import wait as wait_for
from dataclasses import replace
from typing import Any

import numpy as np
from gymnasium.vector.utils import CloudpickleWrapper

from latentplan.config import Config, UserError
from latentplan.config.env_id import imported_modules
from latentplan.config.extras import import_extra
from latentplan.training.collection.collector import CLOSING_SECONDS, EnvFactory
from latentplan.training.collection.episodes import Stopped
from latentplan.training.collection.process import POLL_SECONDS, Answer, Server, WorkerEnded, await_answer

PATIENCE_SECONDS = 30.0  # of an actor that has not started, before a warning says why


class RayWorker:
    """Calls methods of a `Collector` in an actor of the cluster that `join_cluster` has joined.

    Arrays travel through Ray's object store. Worker 0 runs on the machine of the learner if that has a free core, so
    that it can write films there.

    Args:
        config: Settings of the run.
        make_user_env: Makes the user's own environment; None makes the suite's task.
        threads: CPU threads of the actor.
        should_stop: Whether the run stops, so that nobody waits for results.
        number: Number of the collector among those of one run.
    """

    repeats_episodes = False  # the actor that takes the place of one that ended begins new episodes

    def __init__(
        self,
        config: Config,
        make_user_env: EnvFactory | None,
        threads: int = 1,
        should_stop: Callable[[], bool] = lambda: False,
        number: int = 0,
    ) -> None:
        self._ray = import_extra("ray", "collection.backend ray")
        folder = config.collection.keep_episodes
        if folder is not None:  # actors start in another folder
            config = replace(config, collection=replace(config.collection, keep_episodes=os.path.abspath(folder)))
        modules = imported_modules(config.env)
        self._arguments = (config, make_user_env and CloudpickleWrapper(make_user_env), threads, modules, number)
        self._options: dict[str, Any] = {"num_cpus": 0 if config.run.ray_address is None else 1, "max_restarts": 0}
        if number == 0:
            scheduling = importlib.import_module("ray.util.scheduling_strategies")
            here = self._ray.get_runtime_context().get_node_id()
            self._options["scheduling_strategy"] = scheduling.NodeAffinitySchedulingStrategy(here, soft=True)
        self._should_stop, self._number = should_stop, number
        self._start()

    def _start(self) -> None:
        self._actor = self._ray.remote(Server).options(**self._options).remote(*self._arguments)
        self._started: Any = self._actor.__ray_ready__.remote()
        self._futures: deque[Future[Answer]] = deque()

    def restart(self) -> None:
        """Replace an actor that ended by a new one; requests that are not answered yet are dropped."""
        self._kill()
        self._start()

    def publish(self, weights: dict[str, np.ndarray]) -> Any:
        """A reference to weights in the object store, which all workers of a cluster take in place of the weights."""
        return self._ray.put(weights)

    def submit(self, method: str, *arguments: Any) -> None:
        """Ask the actor to run a method; `result` returns the results in the order of the requests."""
        self._futures.append(self._actor.answer.remote(method, *arguments).future())

    def result(self) -> Any:
        """The oldest result that was not returned before; waits until it is there.

        Raises:
            UserError: The method raised this error, or a module is missing where the actor runs.
            Stopped: The run stops.
            WorkerEnded: The actor ended, or its machine did.
            RuntimeError: The method failed with another error.
        """
        exceptions = self._ray.exceptions
        self._await_start()
        try:
            return await_answer(self._futures.popleft(), self._should_stop)
        except exceptions.RayTaskError:
            raise
        except exceptions.RayError as error:
            if self._should_stop():
                raise Stopped from None
            if "creation task" in str(error):
                reason = [line for line in str(error).splitlines() if line.strip()][-1].strip()
                raise UserError(
                    f"a Ray actor cannot start: {reason}; this package and the module of the environment must be "
                    "installed on every machine of the cluster"
                ) from None
            raise WorkerEnded(f"the Ray actor ended unexpectedly ({type(error).__name__})") from None

    def _await_start(self) -> None:
        """Returns when the actor has started or failed to, or when the run stops; warns once if that takes long."""
        if self._started is None:
            return
        asked, has_warned = time.monotonic(), False
        while not self._ray.wait([self._started], timeout=POLL_SECONDS)[0]:
            if self._should_stop():
                return
            if not has_warned and time.monotonic() - asked > PATIENCE_SECONDS:
                has_warned = True
                warnings.warn(
                    f"worker {self._number} has not started yet: the cluster has no free core, or is busy",
                    RuntimeWarning,
                    stacklevel=2,
                )
        self._started = None

    @property
    def oldest(self) -> Future[Answer]:
        """The answer that `result` returns next."""
        return self._futures[0]

    def close(self) -> None:
        """Ends the actor, even if a method is still running."""
        if not self._futures:
            self.submit("close")
            wait_for(self._futures, timeout=CLOSING_SECONDS)
        self._kill()

    def _kill(self) -> None:
        with contextlib.suppress(self._ray.exceptions.RayError):
            self._ray.kill(self._actor)
