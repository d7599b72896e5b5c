"""What runs beside the control loop: the process or thread that searches, and the thread that talks to it."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import traceback
from collections.abc import Iterator
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from queue import SimpleQueue
from typing import Any, NamedTuple

import torch

from latentplan.planning.model import State
from latentplan.planning.plan import Plan

CLOSING_SECONDS = 2.0
# MCL_CURRENT | MCL_ONFAULT of mlockall(2); without MCL_FUTURE, under which a limit would let later memory fail.
LOCK_ON_USE = 1 | 4

Answer = tuple[str, Any]  # "ready", "plan" with (tick, plan), "error" with (error, where), or "ended"
Problem = tuple[Any, ...]  # planner, model, objective, constraints
Goals = tuple[Any, Any]  # objective, constraints


class Request(NamedTuple):
    """What is to be searched, and goals that hold from this search on: as they are, as bytes, or None for the old."""

    state: State
    tick: int
    previous: Plan | None
    seed: int | None
    goals: Goals | bytes | None


def settle() -> bool:
    """Keep away from this process what would stop it for long; to be called before a control loop.

    Everything that exists now is taken out of garbage collection, after one last: a full one walks through all that
    torch and others have imported, a tenth of a second in which no thread runs Python, and comes when enough else has
    been made. What is made later is collected as ever. Pages of the memory there is now stay where they are once they
    have been used, if the system allows that.

    Returns:
        Whether the system allows it: on Linux, with the capability or the limit for locked memory.
    """
    gc.collect()
    gc.freeze()
    lock = getattr(ctypes.CDLL(None), "mlockall", None) if sys.platform == "linux" else None
    return lock is not None and lock(LOCK_ON_USE) == 0


def start_process() -> tuple[SpawnProcess, Connection]:
    """A spawned process that waits for its problem, and our end of the pipe to it."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(theirs,), name="latentplan-plan", daemon=True)
    with _interrupts_held():  # a process that starts inherits that, and lets them go once it ignores them
        process.start()
    theirs.close()
    return process, ours


def dump(problem: Problem) -> bytes:
    """A problem or goals as bytes, by value: torch's own way over pipes shares memory, which outlives a crash.

    Raises:
        TypeError: It cannot be sent to another process.
    """
    try:
        return pickle.dumps(problem)
    except Exception as error:
        raise TypeError(
            f"planner, model, objective and constraints must be picklable to plan in another process ({error}); "
            "define them at the top of a module, or give worker='thread'"
        ) from error


def drive_process(
    connection: Connection,
    problem: bytes,
    requests: SimpleQueue[Request | None],
    answers: SimpleQueue[Answer],
    ready: threading.Event,
) -> None:
    """Waits on the pipe in a thread of the loop's process, so that the loop never waits for a full or empty one."""
    try:
        connection.send_bytes(problem)
        started = pickle.loads(connection.recv_bytes())
        if started[0] != "ready":
            answers.put(started)
        ready.set()
        while (request := requests.get()) is not None:
            answers.put(_exchange(connection, request))
    except (EOFError, OSError):
        answers.put(("ended", None))
    finally:
        ready.set()
        connection.close()


def drive_search(
    problem: Problem, requests: SimpleQueue[Request | None], answers: SimpleQueue[Answer], ready: threading.Event
) -> None:
    """Searches in a thread of the loop's process."""
    ready.set()
    search = _Search(problem)
    while (request := requests.get()) is not None:
        try:
            answers.put(search(request))
        except BaseException as error:  # such as SystemExit, which would end the thread without a word
            answers.put(("error", _portable(RuntimeError(f"{type(error).__name__}: {error}"))))


def end(
    owner: int, requests: SimpleQueue[Request | None], thread: threading.Thread, process: SpawnProcess | None
) -> None:
    """End a worker, whatever it is doing; only a thread that hangs is left behind, as a daemon.

    A fork of the loop's process has no worker to end.
    """
    if os.getpid() != owner:
        return
    requests.put(None)
    if process is not None:
        process.terminate()  # it holds nothing that would have to be put away
        process.join(CLOSING_SECONDS)
        if process.is_alive():
            process.kill()
            process.join()
    if thread is not threading.current_thread():  # garbage is collected in any thread
        thread.join(CLOSING_SECONDS)


def _exchange(connection: Connection, request: Request) -> Answer:
    try:
        message = pickle.dumps(request)
    except Exception as error:
        return "error", _portable(error)
    connection.send_bytes(message)
    received = connection.recv_bytes()
    try:
        answer: Answer = pickle.loads(received)
    except Exception as error:
        return "error", _portable(error)
    return answer


@contextlib.contextmanager
def _interrupts_held() -> Iterator[None]:
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve(connection: Connection) -> None:
    """Searches in a process of its own, until the other end of the pipe is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the loop decides what follows
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    torch.set_num_threads(1)
    try:
        try:
            problem = pickle.loads(connection.recv_bytes())
        except (AttributeError, ImportError, pickle.UnpicklingError) as error:  # defined where this process cannot see
            connection.send_bytes(pickle.dumps(("error", _portable(error))))
            return
        search = _Search(problem)
        settle()
        connection.send_bytes(pickle.dumps(("ready", None)))
        while True:
            connection.send_bytes(pickle.dumps(search(pickle.loads(connection.recv_bytes()))))
    except (EOFError, OSError):
        return


class _Search:
    """Answers one request after another, each with the latest goals."""

    def __init__(self, problem: Problem) -> None:
        self._planner, self._model, *goals = problem
        self._goals: Any = tuple(goals)

    def __call__(self, request: Request) -> Answer:
        """The plan, or what went wrong; goals that cannot be read go wrong until there are others."""
        if request.goals is not None:
            self._goals = request.goals
        generator = None if request.seed is None else torch.Generator().manual_seed(request.seed)
        try:
            if isinstance(self._goals, bytes):
                self._goals = pickle.loads(self._goals)
            objective, constraints = self._goals
            plan = self._planner.plan(
                self._model,
                request.state,
                request.previous,
                objective=objective,
                constraints=constraints,
                generator=generator,
            )
        except Exception as error:
            return "error", _portable(error)
        return "plan", (request.tick, plan)


def _portable(error: Exception) -> tuple[Exception, str]:
    """An error that survives the pipe, and where it happened."""
    where = traceback.format_exc()
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        error = RuntimeError(f"{type(error).__name__}: {error}")
    return error.with_traceback(None), where
