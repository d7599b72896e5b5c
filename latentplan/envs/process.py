"""One environment of a vector environment, in this process or in a process of its own that can be replaced."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection, wait
from typing import Any, Protocol

import gymnasium
from gymnasium.vector.utils import CloudpickleWrapper

from latentplan.config.checks import EnvironmentFault
from latentplan.envs.faults import check_reset, check_step, describe_failure
from latentplan.envs.threads import single_threaded_children

START_SECONDS = 300.0  # for the imports and the first objects of an environment
CLOSING_SECONDS = 5.0
ATTRIBUTES = ("observation_space", "action_space", "metadata", "decisions_per_episode", "labels", "spaces", "interface")

Factory = Callable[[], gymnasium.Env[Any, Any]]


class Lane(Protocol):
    """An environment that is asked for one result at a time."""

    @property
    def facts(self) -> dict[str, Any]:
        """The attributes of the environment that are in `ATTRIBUTES`, and `can_render_large`."""

    def ask(self, method: str, *arguments: Any, **named: Any) -> None:
        """Ask the environment to run a method."""

    def answer(self) -> Any:
        """The result of the method that was asked for.

        Raises:
            EnvironmentFault: The environment failed; only `restart` makes it usable again.
            UserError: The environment refuses the settings.
        """

    def restart(self) -> None:
        """Make the environment anew."""

    def ask_to_close(self) -> None:
        """Ask the environment to end by itself."""

    def close(self, timeout: float = CLOSING_SECONDS) -> None:
        """End the environment, by force if it has not ended after `timeout` seconds."""


class LocalLane:
    """An environment in this process: an exception or a wrong value is a fault, a crash or a hang is not noticed.

    Args:
        factory: Makes the environment.
    """

    def __init__(self, factory: Factory) -> None:
        self._factory = factory
        self._env: gymnasium.Env[Any, Any] | None = self._make()
        self.facts = read_facts(self._env)

    def ask(self, method: str, *arguments: Any, **named: Any) -> None:
        """See `Lane.ask`."""
        self._asked = method, arguments, named

    def answer(self) -> Any:
        """See `Lane.answer`."""
        if self._env is None:
            self._env = self._make()
        try:
            return _run(self._env, *self._asked)
        except (Exception, SystemExit) as error:
            raise describe_failure(error) from error

    def restart(self) -> None:
        """See `Lane.restart`."""
        self.close()
        self._env = None

    def ask_to_close(self) -> None:
        """See `Lane.ask_to_close`."""

    def close(self, timeout: float = CLOSING_SECONDS) -> None:
        """See `Lane.close`."""
        if self._env is not None:
            with contextlib.suppress(Exception):  # an environment that failed may fail to close too
                self._env.close()

    def _make(self) -> gymnasium.Env[Any, Any]:
        try:
            return self._factory()
        except (Exception, SystemExit) as error:
            raise describe_failure(error) from error


class ProcessLane:
    """An environment in a spawned process: a crash is noticed at once, a hang after a time.

    The process starts in the background; the first answer waits for it.

    Args:
        factory: Makes the environment; it must be picklable.
        timeout_s: Seconds that a reset or a step may take.
    """

    def __init__(self, factory: Factory, timeout_s: float) -> None:
        self._factory, self._timeout_s = CloudpickleWrapper(factory), timeout_s
        self._facts: dict[str, Any] | None = None
        self._start()

    @property
    def facts(self) -> dict[str, Any]:
        """See `Lane.facts`; the first look waits for the process."""
        if self._facts is None:
            self._await_start()
        assert self._facts is not None
        return self._facts

    def ask(self, method: str, *arguments: Any, **named: Any) -> None:
        """See `Lane.ask`."""
        self._fault: EnvironmentFault | None = None
        try:
            self._await_start()
            self._num_asked += 1
            self._connection.send((self._num_asked, method, arguments, named))
        except OSError:
            pass  # a process that ended is noticed by `answer`
        except EnvironmentFault as fault:
            self._fault = fault

    def answer(self) -> Any:
        """See `Lane.answer`."""
        if self._fault is not None:
            raise self._fault
        return self._receive(self._num_asked, self._timeout_s)

    def restart(self) -> None:
        """See `Lane.restart`."""
        if self._has_answered:  # it failed, but runs: it can end its simulator
            self.ask_to_close()
        self.close(CLOSING_SECONDS if self._has_answered else 0.0)
        self._start()

    def ask_to_close(self) -> None:
        """See `Lane.ask_to_close`."""
        with contextlib.suppress(OSError):
            self._connection.send((self._num_asked + 1, "close", (), {}))

    def close(self, timeout: float = CLOSING_SECONDS) -> None:
        """See `Lane.close`."""
        self._process.join(timeout)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._connection.close()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, child_end = context.Pipe()
        self._process = context.Process(target=_serve, args=(child_end, self._factory), daemon=True)
        with single_threaded_children():
            self._process.start()
        child_end.close()
        self._is_started = self._has_answered = False
        self._num_asked = 0

    def _await_start(self) -> None:
        if not self._is_started:
            self._facts = self._receive(0, max(START_SECONDS, self._timeout_s))()
            self._is_started = True

    def _receive(self, number: int, timeout_s: float) -> Any:
        """The answer to a request with a number; 0 is the start. Answers that an interrupt left behind are dropped."""
        self._has_answered = False
        try:
            answered = -1
            while answered != number:
                if not self._connection.poll(timeout_s):
                    raise EnvironmentFault(
                        f"the environment has not answered for {timeout_s:g} s: make it faster, or allow more with "
                        "--collection.step_timeout_s"
                    )
                answered, (kind, value) = self._connection.recv()
        except (EOFError, OSError):
            self._process.join(CLOSING_SECONDS)
            code = self._process.exitcode
            raise EnvironmentFault(
                f"the environment's process ended unexpectedly (exit code {code}): look for os._exit, or a crash or a "
                "lack of memory in native code"
            ) from None
        self._has_answered = True
        if kind == "ok":
            return value
        raise value


def read_facts(env: gymnasium.Env[Any, Any]) -> dict[str, Any]:
    """The attributes of an environment in `ATTRIBUTES`, also of the environment inside its wrappers."""
    facts = {name: env.get_wrapper_attr(name) if env.has_wrapper_attr(name) else None for name in ATTRIBUTES}
    return {**facts, "can_render_large": env.has_wrapper_attr("render_large")}


def _run(env: gymnasium.Env[Any, Any], method: str, arguments: tuple[Any, ...], named: dict[str, Any]) -> Any:
    """The result of a method of an environment; that of `reset` and `step` is checked."""
    result = env.get_wrapper_attr(method)(*arguments, **named)
    check = {"reset": check_reset, "step": check_step}.get(method)
    return result if check is None else check(result, env.observation_space.shape or ())


def _serve(connection: Connection, factory: CloudpickleWrapper) -> None:
    """Makes an environment and runs its methods as they are asked for, until the connection closes."""
    for number in (signal.SIGINT, signal.SIGHUP):  # they reach the whole process group; the parent handles them
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=end_with_parent, daemon=True).start()
    # Python refuses children to a process that ends with its parent, but a simulator may be one.
    multiprocessing.current_process()._config["daemon"] = False  # type: ignore[attr-defined]
    env: Any = None
    asked = 0
    answer: tuple[str, Any]
    try:
        env = factory()
        facts = read_facts(env)
        answer = "ok", CloudpickleWrapper(lambda: facts)  # a space may be of a class of the script's own
    except BaseException as error:
        answer = "failed", describe_failure(error)
    while True:
        try:
            _send(connection, asked, answer)
            asked, *request = connection.recv()
        except (EOFError, OSError):
            os._exit(0)
        try:
            answer = "ok", _run(env, *request)
        except BaseException as error:  # also SystemExit: the environment may call sys.exit()
            answer = "failed", describe_failure(error)
        if request[0] == "close":
            return


def _send(connection: Connection, number: int, answer: tuple[str, Any]) -> None:
    """Sends an answer; one that cannot be sent, such as an info that holds a lambda, is a fault of the environment."""
    try:
        connection.send((number, answer))
    except (OSError, EnvironmentFault):
        raise
    except Exception as error:
        connection.send((number, ("failed", describe_failure(error))))


def end_with_parent() -> None:
    """Ends this process and its children when the process that started it has ended, even if other threads hang."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        for child in multiprocessing.active_children():
            child.kill()
        os._exit(0)
