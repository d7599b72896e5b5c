"""Deadlines: the durations of the parts of earlier searches, and the time left for the present one."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field

import torch

NUM_DURATIONS = 32  # durations of a part that count
QUANTILE = 0.9  # of these durations, the expected one
PATIENCE = 10  # refusals in a row after which the fastest duration is expected
ENOUGH = 4  # durations among which one that is usual is expected to be
ROUNDING = 1.0 + 1e-9  # factor by which a sum of durations may exceed the budget, because sums are rounded


class Pace:
    """The durations of the parts of a search, by problem size.

    The expected duration of a part is the 0.9 quantile of its last 32 durations, and 0 without any. The first duration
    never counts, because it includes lazy initialisation. After 10 refusals in a row the fastest duration is expected,
    and 0 while fewer than four are known, so that one slow search does not exclude a part for ever.

    A copy starts without durations, because the copy may run on another machine.
    """

    def __init__(self) -> None:
        self._durations: dict[Hashable, _Durations] = {}

    def expected(self, *keys: Hashable) -> float:
        """Returns the expected duration of a part in seconds, by the first key of which one is known, 0 without any."""
        known = [self._durations[key] for key in keys if key in self._durations and self._durations[key].recent]
        if not known:
            return 0.0
        durations = known[0]
        if durations.num_refusals >= PATIENCE:
            return durations.fastest if len(durations.recent) >= ENOUGH else 0.0
        return sorted(durations.recent)[math.ceil(QUANTILE * (len(durations.recent) - 1))]

    def record(self, key: Hashable, seconds: float) -> None:
        """Records the duration of a part."""
        durations = self._durations.setdefault(key, _Durations())
        durations.num_refusals = 0
        if durations.is_warmed_up:
            durations.recent.append(seconds)
            durations.fastest = min(durations.fastest, seconds)
        durations.is_warmed_up = True

    def refuse(self, key: Hashable) -> None:
        """Records that a part was not started for want of time."""
        self._durations.setdefault(key, _Durations()).num_refusals += 1

    def __reduce__(self) -> tuple[type[Pace], tuple[()]]:
        return Pace, ()


class Budget:
    """The time of one search.

    Args:
        pace: Durations of earlier searches; this search adds its own.
        size: Problem size of this search; durations of other sizes are not used.
        kind: What the search computes; durations of other kinds are used as long as this kind has none.
        clock: Returns the time in seconds.
        started: Time at which the search began.
        seconds: Duration that is allowed; None sets no limit.
        device: Device on which the search computes.
    """

    def __init__(
        self,
        pace: Pace,
        size: Hashable,
        kind: Hashable,
        clock: Callable[[], float],
        started: float,
        seconds: float | None,
        device: torch.device,
    ) -> None:
        self._pace, self._size, self._kind, self._clock = pace, size, kind, clock
        self._started, self._seconds = started, seconds
        self._is_asynchronous = device.type == "cuda"
        self._device = device
        self._lap_started = started

    def allows(self, *parts: str) -> bool:
        """Returns whether these parts, one after the other, are expected to end in time."""
        if self._seconds is None:
            return True
        elapsed = self._now() - self._started
        expected = sum(self._pace.expected(*self._keys(part)) for part in parts)
        if elapsed < self._seconds and elapsed + expected <= self._seconds * ROUNDING:
            return True
        for key in (key for part in parts for key in self._keys(part)):
            self._pace.refuse(key)
        return False

    def lap(self, part: str | None = None) -> None:
        """Records the time since the last lap as the duration of a part; None only starts the next lap."""
        if self._is_asynchronous and self._seconds is None:
            return  # without a limit no duration is needed, and measuring one would wait for the device
        now = self._now()
        if part is not None:
            for key in self._keys(part):
                self._pace.record(key, now - self._lap_started)
        self._lap_started = now

    def _keys(self, part: str) -> tuple[Hashable, Hashable]:
        return (part, self._size, self._kind), (part, self._size)

    def _now(self) -> float:
        if self._is_asynchronous:
            torch.cuda.synchronize(self._device)
        return self._clock()


@dataclass
class _Durations:
    """Durations of one part of a search in seconds, without the first one, and the number of refusals since."""

    recent: deque[float] = field(default_factory=lambda: deque(maxlen=NUM_DURATIONS))
    fastest: float = math.inf
    is_warmed_up: bool = False
    num_refusals: int = 0
