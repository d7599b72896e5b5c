"""The process or thread that searches beside the control loop, and the thread that exchanges messages with it."""

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
from multiprocessing import resource_tracker
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

Answer = tuple[str, Any]  # "ready", "plan" with (tick, plan), "error" with (error, traceback), or "ended"
Problem = tuple[Any, ...]  # planner, model, objective, constraints
Goals = tuple[Any, Any]  # objective, constraints


class Request(NamedTuple):
    """A search request.

    Attributes:
        state: The state predicted for `tick`, rows (batch,).
        tick: Tick of the plan's first action.
        previous: Previous plan for a warm start.
        seed: Seed of the search's random stream; None takes torch's default.
        goals: Objective and constraints from this request on, pickled or not; None keeps the present ones.
    """

    state: State
    tick: int
    previous: Plan | None
    seed: int | None
    goals: Goals | bytes | None


def settle() -> bool:
    """Prevents long pauses of this process by garbage collection and paging; call it before a control loop.

    A full garbage collection visits every object of torch and other libraries, which stops all threads for about 0.1 s.
    This function collects garbage once, and then excludes all present objects from later collections. It also locks
    the present memory pages once they have been used, if the system allows that.

    Returns:
        Whether memory was locked; Linux allows this by a capability or by the limit for locked memory.
    """
    gc.collect()
    gc.freeze()
    lock = getattr(ctypes.CDLL(None), "mlockall", None) if sys.platform == "linux" else None
    return lock is not None and lock(LOCK_ON_USE) == 0


def start_process() -> tuple[SpawnProcess, Connection]:
    """Returns a spawned process that waits for its problem, and this process's end of the pipe."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(theirs,), name="latentplan-plan", daemon=True)
    resource_tracker.ensure_running()  # its start unblocks interrupts, so it must precede the block
    with _blocked_interrupts():  # the child inherits the blocked signal, and unblocks it once it ignores interrupts
        process.start()
    theirs.close()
    return process, ours


def dump(problem: Problem) -> bytes:
    """Returns a problem or goals as bytes that hold copies of all tensors.

    Torch would otherwise share the memory of tensors between processes, and this memory would outlive a crash.

    Raises:
        TypeError: The problem cannot be pickled.
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
    """Exchanges messages with the process; runs in a thread, so that the control loop never waits for the pipe."""
    has_started = False
    try:
        connection.send_bytes(problem)
        started = pickle.loads(connection.recv_bytes())
        if started[0] != "ready":
            answers.put(started)
        has_started = True
        ready.set()
        while (request := requests.get()) is not None:
            answers.put(_exchange(connection, request))
    except (EOFError, OSError):
        answers.put(("ended", has_started))
    finally:
        ready.set()
        connection.close()


def drive_search(
    problem: Problem, requests: SimpleQueue[Request | None], answers: SimpleQueue[Answer], ready: threading.Event
) -> None:
    """Answers search requests in a thread of the control loop's process."""
    ready.set()
    search = _Search(problem)
    while (request := requests.get()) is not None:
        try:
            answers.put(search(request))
        except BaseException as error:  # SystemExit, for example, would end the thread without a message
            answers.put(("error", _make_portable(RuntimeError(f"{type(error).__name__}: {error}"))))


def end_worker(
    owner: int, requests: SimpleQueue[Request | None], thread: threading.Thread, process: SpawnProcess | None
) -> None:
    """Ends a worker, even during a search. A thread that hangs goes on as a daemon.

    In a fork of the control loop's process this function does nothing, because the worker belongs to the parent.
    """
    if os.getpid() != owner:
        return
    requests.put(None)
    if process is not None:
        process.terminate()  # the process holds no resource that needs a clean end
        process.join(CLOSING_SECONDS)
        if process.is_alive():
            process.kill()
            process.join()
    if thread is not threading.current_thread():  # a finalizer may run in any thread
        thread.join(CLOSING_SECONDS)


def _exchange(connection: Connection, request: Request) -> Answer:
    try:
        message = pickle.dumps(request)
    except Exception as error:
        return "error", _make_portable(error)
    connection.send_bytes(message)
    received = connection.recv_bytes()
    try:
        answer: Answer = pickle.loads(received)
    except Exception as error:
        return "error", _make_portable(error)
    return answer


@contextlib.contextmanager
def _blocked_interrupts() -> Iterator[None]:
    """Blocks the signal of Ctrl-C inside the `with` block."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve(connection: Connection) -> None:
    """Answers search requests in a process of its own, until the other end of the pipe is closed."""
    # Ctrl-C reaches the whole process group, and the process of the control loop handles it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    torch.set_num_threads(1)
    try:
        message = connection.recv_bytes()
        try:
            problem = pickle.loads(message)
        except Exception as error:  # it may use a definition of a module that this process cannot import
            connection.send_bytes(pickle.dumps(("error", _make_portable(error))))
            return
        search = _Search(problem)
        settle()
        connection.send_bytes(pickle.dumps(("ready", None)))
        while True:
            connection.send_bytes(_dump_answer(_answer(search, connection.recv_bytes())))
    except (EOFError, OSError):
        return


def _dump_answer(answer: Answer) -> bytes:
    """Returns an answer as bytes; a plan that cannot be pickled, as of a planner with a lambda in it, is an error."""
    try:
        return pickle.dumps(answer)
    except Exception as error:
        return pickle.dumps(("error", _make_portable(error)))


def _answer(search: _Search, message: bytes) -> Answer:
    """Returns the answer to a pickled request; a state that this process cannot unpickle is an error."""
    try:
        request = pickle.loads(message)
    except Exception as error:
        return "error", _make_portable(error)
    return search(request)


class _Search:
    """Answers requests one after another, with the goals of the last request that had any."""

    def __init__(self, problem: Problem) -> None:
        self._planner, self._model, *goals = problem
        self._goals: Any = tuple(goals)

    def __call__(self, request: Request) -> Answer:
        """Returns the plan or the error; goals that cannot be unpickled give an error until new goals arrive."""
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
            return "error", _make_portable(error)
        return "plan", (request.tick, plan)


def _make_portable(error: Exception) -> tuple[Exception, str]:
    """Returns an exception that can be pickled, and its traceback as text."""
    text = traceback.format_exc()
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        error = RuntimeError(f"{type(error).__name__}: {error}")
    return error.with_traceback(None), text
