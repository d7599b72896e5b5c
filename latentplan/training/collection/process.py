"""Workers: run a `Collector` in this process, or in another process beside the learner."""

from __future__ import annotations

import contextlib
import importlib
import multiprocessing
import signal
import sys
import threading
import traceback
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import wait as wait_for
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import torch
from gymnasium.vector.utils import CloudpickleWrapper

from latentplan.config import Config, EnvironmentFault, UserError
from latentplan.config.env_id import imported_modules
from latentplan.envs import single_threaded_children
from latentplan.envs.process import end_with_parent
from latentplan.training.collection.collector import CLOSING_SECONDS, Collector, EnvFactory
from latentplan.training.collection.episodes import Stopped

POLL_SECONDS = 0.1  # between two looks at whether the run stops


class WorkerEnded(RuntimeError):
    """The collection process ended, and its answers are lost."""


Answer = tuple[str, Any]  # "ok", "user_error" or "error", and the result, the error or its traceback


class Server:
    """Answers requests in a collection process, by a `Collector` that the first request makes.

    Args:
        config: Settings of the run.
        make_user_env: Makes the user's own environment; None makes the suite's task.
        threads: CPU threads of the process.
        modules: Modules that register the environment.
        number: Number of the collector among those of one run.
    """

    def __init__(
        self, config: Config, make_user_env: EnvFactory | None, threads: int, modules: tuple[str, ...], number: int
    ) -> None:
        torch.set_num_threads(threads)
        self._arguments, self._modules = (config, make_user_env, "cpu", number), modules
        self._collector: Collector | None = None

    def answer(self, method: str, *arguments: Any) -> Answer:
        """Runs a method of the collector; errors are answers too."""
        try:
            if self._collector is None:
                for module in self._modules:
                    importlib.import_module(module)
                self._collector = Collector(*self._arguments)
            return "ok", getattr(self._collector, method)(*arguments)
        except UserError as error:
            return "user_error", error if isinstance(error, EnvironmentFault) else UserError(str(error))
        except Exception:
            return "error", traceback.format_exc()

    def close(self) -> None:
        """Ends the simulators."""
        if self._collector is not None:
            with contextlib.suppress(Exception):  # an environment that failed may fail to close too
                self._collector.close()


def await_answer(future: Future[Answer], should_stop: Callable[[], bool]) -> Any:
    """The result in the answer of a `Server`; waits until it is there.

    Raises:
        UserError: The method raised this error.
        Stopped: The run stops.
        RuntimeError: The method failed with another error.
        Exception: The future has failed.
    """
    while not future.done() and not should_stop():
        wait_for([future], timeout=POLL_SECONDS)
    if not future.done():
        raise Stopped
    kind, value = future.result()
    if kind == "user_error":
        raise value
    if kind == "error":
        raise RuntimeError(f"collection failed:\n{value}")
    return value


class LocalWorker:
    """Calls methods of a `Collector` in this process; `submit` returns when the method is done.

    Args:
        config: Settings of the run.
        make_user_env: Makes the user's own environment; None makes the suite's task.
        device: Device of the acting model.
        should_stop: Whether the run stops, so that a round is given up.
    """

    replaced = 0

    def __init__(
        self,
        config: Config,
        make_user_env: EnvFactory | None,
        device: str,
        should_stop: Callable[[], bool] = lambda: False,
    ) -> None:
        self._collector = Collector(config, make_user_env, device)
        self._collector.should_stop = should_stop
        self._results: list[Any] = []

    def submit(self, method: str, *arguments: Any) -> None:
        """Run a method of the collector, and keep its result for `result`.

        Raises:
            Stopped: The run stops.
        """
        self._results.append(getattr(self._collector, method)(*arguments))

    def result(self) -> Any:
        """The oldest result that was not returned before."""
        return self._results.pop(0)

    def close(self) -> None:
        """Ends the simulators."""
        self._collector.close()


class PatientWorker(LocalWorker):
    """A local worker whose errors `result` raises, as those of another process.

    Processes that learn together agree on what each of them gets from `result`, and all submit before they ask.
    """

    def submit(self, method: str, *arguments: Any) -> None:
        """Run a method of the collector, unless an earlier one failed, and keep its result or error for `result`."""
        if any(isinstance(value, Exception) for value in self._results):
            self._results.append(Stopped())
            return
        try:
            super().submit(method, *arguments)
        except Exception as error:
            self._results.append(error)

    def result(self) -> Any:
        """The oldest result that was not returned before; raises it if it is an error."""
        value = super().result()
        if isinstance(value, Exception):
            raise value
        return value


class RemoteWorker:
    """Calls methods of a `Collector` in a spawned process, on the CPU; `submit` returns at once.

    Args:
        config: Settings of the run.
        make_user_env: Makes the user's own environment; None makes the suite's task.
        threads: CPU threads of the process.
        should_stop: Whether the run stops, so that nobody waits for results.
        number: Number of the collector among those of one run.
    """

    replaced = 0  # processes that the worker itself has replaced
    repeats_episodes = True  # a collector that continues from the memory of another repeats its episodes

    def __init__(
        self,
        config: Config,
        make_user_env: EnvFactory | None,
        threads: int = 1,
        should_stop: Callable[[], bool] = lambda: False,
        number: int = 0,
    ) -> None:
        modules = imported_modules(config.env)
        self._arguments = (config, make_user_env and CloudpickleWrapper(make_user_env), threads, modules, number)
        self._should_stop = should_stop
        self._start()

    def restart(self) -> None:
        """Replace a process that ended by a new one; requests that are not answered yet are dropped."""
        self.close()
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, child_end = context.Pipe()
        self._process = context.Process(target=_serve, args=(child_end, *self._arguments), daemon=False)
        with single_threaded_children():
            self._process.start()
        child_end.close()
        # A thread waits on the pipe, so that neither process blocks while the buffer of the other is full.
        self._caller = ThreadPoolExecutor(max_workers=1)
        self._futures: deque[Future[Answer]] = deque()

    def publish(self, weights: dict[str, np.ndarray]) -> Any:
        """The weights in the form in which all workers take them."""
        return weights

    def submit(self, method: str, *arguments: Any) -> None:
        """Ask the process to run a method; `result` returns the results in the order of the requests."""
        self._futures.append(self._caller.submit(self._call, method, arguments))

    def result(self) -> Any:
        """The oldest result that was not returned before; waits until it is there.

        Raises:
            UserError: The method raised this error.
            Stopped: The run stops.
            WorkerEnded: The process ended.
            RuntimeError: The method failed with another error.
        """
        try:
            return await_answer(self._futures.popleft(), self._should_stop)
        except (EOFError, OSError):
            self._process.join(timeout=5.0)
            if self._should_stop():
                raise Stopped from None
            code = self._process.exitcode
            raise WorkerEnded(f"the collection process ended unexpectedly (exit code {code})") from None

    @property
    def oldest(self) -> Future[Answer]:
        """The answer that `result` returns next."""
        return self._futures[0]

    def close(self) -> None:
        """Ends the process, even if a method is still running."""
        if self._process.is_alive():
            self._process.terminate()
        self._process.join(3 * CLOSING_SECONDS)  # for the environments that collect, then for the one that evaluates
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._caller.shutdown(cancel_futures=True)
        self._connection.close()

    def _call(self, method: str, arguments: tuple[Any, ...]) -> Answer:
        self._connection.send((method, arguments))
        answer: Answer = self._connection.recv()
        return answer


def _serve(
    connection: Connection,
    config: Config,
    make_user_env: EnvFactory | None,
    threads: int,
    modules: tuple[str, ...],
    number: int,
) -> None:
    """Runs methods of a `Collector` in this process as the learner requests them, until the connection closes."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())  # an ordinary exit also ends the environments' processes
    # Ctrl-C and a closed terminal reach the whole process group, but only the learner reacts.
    for received in (signal.SIGINT, signal.SIGHUP):
        signal.signal(received, signal.SIG_IGN)
    threading.Thread(target=end_with_parent, daemon=True).start()
    server = Server(config, make_user_env, threads, modules, number)
    try:
        while True:
            method, arguments = connection.recv()
            connection.send(server.answer(method, *arguments))
    except (EOFError, OSError):  # the learner has ended
        return
    finally:
        server.close()
