"""The pace of the live view: one decision in every period of the wall clock."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

CATCH_UP = 2.0  # periods by which the loop may be behind before it gives them up
WINDOW = 64  # decisions over which the rate is measured


class Pace:
    """Holds the rate of a loop on the wall clock, and measures it.

    A decision that takes too long is followed at once by the next one, until the loop is back in its schedule. A loop
    that is more than `CATCH_UP` periods behind begins a new schedule.

    Attributes:
        period_ms: Milliseconds of a period.
        busy_ms: Milliseconds that the last period's work took.
        num_decisions: Periods so far.
        num_late: Periods whose work ended after the period.

    Args:
        period_s: Seconds of a period.
        clock: Returns the time in seconds.
        sleep: Waits for some seconds.
    """

    def __init__(
        self,
        period_s: float,
        clock: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.period_ms = 1000.0 * period_s
        self.busy_ms, self.num_decisions, self.num_late = 0.0, 0, 0
        self._period_s, self._clock, self._sleep = period_s, clock, sleep
        self.restart()

    def restart(self) -> None:
        """Begins a new schedule now."""
        self._began = self._due = self._clock()
        self._ends: deque[float] = deque(maxlen=WINDOW)

    @property
    def rate(self) -> float | None:
        """Decisions per second over the last decisions; None before there are two."""
        if len(self._ends) < 2:
            return None
        return (len(self._ends) - 1) / max(self._ends[-1] - self._ends[0], 1e-9)

    def finish(self) -> None:
        """Ends the work of one period, and waits until the next one begins."""
        now = self._clock()
        self.busy_ms = 1000.0 * (now - self._began)
        self._due += self._period_s
        self.num_decisions += 1
        self.num_late += now > self._due
        self._ends.append(now)
        if now < self._due:
            self._sleep(self._due - now)
        elif now - self._due > CATCH_UP * self._period_s:
            self._due = now
        self._began = self._clock()
