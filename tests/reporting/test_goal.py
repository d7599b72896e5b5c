"""The strip of a film that shows how an objective is met."""

import numpy as np

from latentplan.reporting.goal import STRIP_HEIGHT, draw_goal
from latentplan.reporting.video import compose_frame

GREEN, RED, BLUE = (90, 200, 120), (225, 100, 85), (120, 170, 240)


def pixels(strip, color, tolerance=12):
    """Rows and columns where the strip is nearly of a colour."""
    return np.argwhere(np.abs(strip.astype(int) - color).max(axis=2) < tolerance)


def test_clauses_are_marked_by_whether_they_are_met():
    strip = draw_goal(520, [0.5, 0.5], [("height > 1.2", True), ("speed -> 1.0", False)])
    assert pixels(strip, GREEN)[:, 0].max() < pixels(strip, RED)[:, 0].min()
    assert pixels(strip, GREEN)[:, 1].min() > 260


def test_the_trace_rises_with_the_objective_and_stays_in_its_half():
    rising = pixels(draw_goal(520, np.linspace(0.0, 1.0, 250).tolist(), []), BLUE, tolerance=50)
    rising = rising[rising[:, 1].argsort()]
    assert rising[0, 0] > rising[-1, 0] + 40
    assert 0 <= rising[:, 1].min() and rising[:, 1].max() < 260
    assert 24 <= rising[:, 0].min() and rising[:, 0].max() < STRIP_HEIGHT


def test_worth_above_one_stays_inside_the_strip():
    high = pixels(draw_goal(520, [0.0, 40.0, -3.0], []), BLUE)
    assert 24 <= high[:, 0].min() and high[:, 0].max() < STRIP_HEIGHT


def test_without_an_objective_the_clauses_take_the_left():
    strip = draw_goal(520, [], [("cart < 0.5", True)])
    assert pixels(strip, GREEN)[:, 1].max() < 60 and len(pixels(strip, BLUE)) == 0


def test_the_strip_keeps_its_size_however_many_clauses_there_are():
    clauses = [("a very long clause " * 10, index % 2 == 0) for index in range(9)]
    assert draw_goal(520, [], clauses).shape == draw_goal(520, [], []).shape == (STRIP_HEIGHT, 520, 3)
    assert len({row // 24 for row in pixels(draw_goal(520, [], clauses), GREEN)[:, 0]}) == 2


def test_the_strip_lies_below_everything_else():
    real = np.zeros((256, 256, 3), np.uint8)
    plain, strip = compose_frame(real, None, ["return 1"]), np.full((STRIP_HEIGHT, 520, 3), BLUE, np.uint8)
    framed = compose_frame(real, None, ["return 1"], strip=strip)
    assert np.array_equal(framed[: len(plain) - 8], plain[:-8])
    assert np.array_equal(framed[-8 - STRIP_HEIGHT : -8, 8:528], strip)
