"""Signals: the first SIGINT, SIGTERM or SIGHUP asks a program to save and stop, a second SIGINT or SIGTERM ends it."""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any

STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def exit_code(number: int) -> int:
    """The exit code of a program that stopped because of a signal, as shells count: 130, 143 or 129."""
    return 128 + number


def raise_interrupt(number: int) -> None:
    """Raises `KeyboardInterrupt`, for a program whose work is repeated from its last save."""
    raise KeyboardInterrupt


class Signals:
    """While its context is open, handles the signals that stop a program.

    A SIGHUP is never the second signal that ends a program: where it arrives together with a SIGTERM, as from a parent
    that asks and ends, Python handles it first.
    SIGHUP stays ignored if it was ignored before, as under `nohup`. Outside of the main thread, where Python handles no
    signals, the context changes nothing.

    Args:
        receive: Called with the number of the first signal.

    Attributes:
        received: Number of the first signal; 0 before it.
        receive: As given.
    """

    def __init__(self, receive: Callable[[int], None] = lambda number: None) -> None:
        self.received, self.receive = 0, receive
        self._was_asked = False  # by a signal other than SIGHUP
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> Signals:
        if threading.current_thread() is threading.main_thread():
            for number in STOPPING:
                if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                    self._previous[number] = signal.getsignal(number)
            self.install()
        return self

    def forget_listener(self) -> None:
        """Calls nothing at a signal any more, and frees what only the object that was called kept in memory."""
        self.receive = lambda number: None
        gc.collect()

    def install(self) -> None:
        """Take the signals back from a library that has set handlers of its own."""
        for number in self._previous:
            signal.signal(number, self._handle)

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._was_asked and number != signal.SIGHUP:
            with contextlib.suppress(OSError, RuntimeError, ValueError):  # a stream that is closed or being written to
                sys.stdout.flush()
                sys.stderr.flush()
            os._exit(exit_code(number))  # worker processes notice that this process has ended
        self._was_asked |= number != signal.SIGHUP
        if not self.received:
            self.received = number
            self.receive(number)
