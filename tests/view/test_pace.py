"""The pace of the loop, on a clock that the test moves."""

import pytest

from latentplan.view.pace import Pace


class Clock:
    """A clock that only sleeping and work move."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now

    def sleep(self, seconds):
        assert seconds >= 0.0
        self.now += seconds


def run(works):
    """The pace after some works of so many seconds, and the times at which the periods began."""
    clock = Clock()
    pace, begins = Pace(0.04, clock, clock.sleep), []
    for work in works:
        begins.append(clock.now - 100.0)
        clock.now += work
        pace.finish()
    return pace, begins


def test_pace_begins_a_decision_in_every_period():
    pace, begins = run([0.01, 0.03, 0.02, 0.0])
    assert begins == pytest.approx([0.0, 0.04, 0.08, 0.12])
    assert pace.num_late == 0 and pace.num_decisions == 4 and pace.busy_ms == pytest.approx(0.0, abs=1e-6)


def test_pace_catches_up_after_a_late_decision():
    pace, begins = run([0.05, 0.01, 0.01, 0.01])
    assert begins == pytest.approx([0.0, 0.05, 0.08, 0.12]) and pace.num_late == 1


def test_pace_gives_up_periods_that_it_cannot_catch_up():
    pace, begins = run([0.5, 0.01, 0.01])
    assert begins == pytest.approx([0.0, 0.5, 0.54]) and pace.num_late == 1


def test_pace_measures_the_rate_that_it_holds():
    assert run([0.01] * 100)[0].rate == pytest.approx(25.0)
    assert run([0.08] * 100)[0].rate == pytest.approx(12.5)
    assert run([0.01])[0].rate is None


def test_pace_forgets_its_schedule_when_it_restarts():
    clock = Clock()
    pace = Pace(0.04, clock, clock.sleep)
    pace.finish()
    clock.now += 60.0
    pace.restart()
    began = clock.now
    pace.finish()
    assert clock.now == pytest.approx(began + 0.04) and pace.num_late == 0 and pace.rate is None
