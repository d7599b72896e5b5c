"""How much of a search still fits: what its parts took before, and what is left of the budget."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field

import torch

NUM_DURATIONS = 32
QUANTILE = 0.9
PATIENCE = 10
ROUNDING = 1.0 + 1e-9  # sums of durations that fill a budget exactly still fit


@dataclass
class _Durations:
    """Seconds that one part of a search took, the first time left out; and refusals since the last."""

    recent: deque[float] = field(default_factory=lambda: deque(maxlen=NUM_DURATIONS))
    fastest: float = math.inf
    is_warmed_up: bool = False
    num_refusals: int = 0


class Pace:
    """What the parts of a search took at each problem size.

    A part is expected to take the 0.9 quantile of its last 32 durations. The first duration never counts, because it
    includes lazy initialisation; nothing is expected of a part without a duration. A part that was refused 10 times in
    a row is tried once more if its fastest duration ever would fit, so that one hiccup does not end it for good.

    A copy starts without durations: it may live on another machine, and has to warm up there.
    """

    def __init__(self) -> None:
        self._durations: dict[Hashable, _Durations] = {}

    def expected(self, key: Hashable) -> float:
        """Seconds that a part is expected to take, 0 where nothing is known."""
        durations = self._durations.get(key)
        if durations is None or not durations.recent:
            return 0.0
        if durations.num_refusals >= PATIENCE:
            return durations.fastest
        return sorted(durations.recent)[math.ceil(QUANTILE * (len(durations.recent) - 1))]

    def record(self, key: Hashable, seconds: float) -> None:
        """Note what a part took."""
        durations = self._durations.setdefault(key, _Durations())
        durations.num_refusals = 0
        if durations.is_warmed_up:
            durations.recent.append(seconds)
            durations.fastest = min(durations.fastest, seconds)
        durations.is_warmed_up = True

    def refuse(self, key: Hashable) -> None:
        """Note that a part was not started for want of time."""
        self._durations.setdefault(key, _Durations()).num_refusals += 1

    def __reduce__(self) -> tuple[type[Pace], tuple[()]]:
        return Pace, ()


class Budget:
    """The time of one search.

    Args:
        pace: What the parts took before; learns what they take now.
        size: Problem size that durations hold for.
        clock: Gives the time in seconds.
        started: When the search began.
        seconds: What it may take; None is as long as it likes.
        device: Where it computes.
    """

    def __init__(
        self,
        pace: Pace,
        size: Hashable,
        clock: Callable[[], float],
        started: float,
        seconds: float | None,
        device: torch.device,
    ) -> None:
        self._pace, self._size, self._clock = pace, size, clock
        self._started, self._seconds = started, seconds
        self._is_asynchronous = device.type == "cuda"
        self._device = device
        self._lap_started = started

    def allows(self, *parts: str) -> bool:
        """Whether these parts, one after the other, are expected to end in time."""
        if self._seconds is None:
            return True
        elapsed = self._now() - self._started
        expected = sum(self._pace.expected((part, self._size)) for part in parts)
        if elapsed < self._seconds and elapsed + expected <= self._seconds * ROUNDING:
            return True
        for part in parts:
            self._pace.refuse((part, self._size))
        return False

    def lap(self, part: str | None = None) -> None:
        """Note the time since the last lap as the duration of a part; None only starts the next lap."""
        if self._is_asynchronous and self._seconds is None:
            return  # waiting for the device only to know the time would cost time
        now = self._now()
        if part is not None:
            self._pace.record((part, self._size), now - self._lap_started)
        self._lap_started = now

    def _now(self) -> float:
        if self._is_asynchronous:
            torch.cuda.synchronize(self._device)
        return self._clock()
