"""Frames of a film: two pictures, text, and the strip with the goals."""

import numpy as np
import pytest

from latentplan.reporting.frame import PANEL_SIZE, STRIP_HEIGHT, compose_frame, draw_goal_strip

GREEN, RED, BLUE = (90, 200, 120), (225, 100, 85), (120, 170, 240)


def picture(size, color):
    return np.full((size, size, 3), color, np.uint8)


def pixels(strip, color, tolerance=12):
    """Rows and columns where the strip is nearly of a colour."""
    return np.argwhere(np.abs(strip.astype(int) - color).max(axis=2) < tolerance)


def test_draw_goal_strip_marks_met_clauses_green_and_others_red():
    strip = draw_goal_strip([0.5, 0.5], [("height > 1.2", True), ("speed -> 1.0", False)])
    assert pixels(strip, GREEN)[:, 0].max() < pixels(strip, RED)[:, 0].min()
    assert pixels(strip, GREEN)[:, 1].min() > 260


def test_draw_goal_strip_draws_rising_scores_as_a_rising_line_in_the_left_half():
    rising = pixels(draw_goal_strip(np.linspace(0.0, 1.0, 250).tolist(), []), BLUE, tolerance=50)
    rising = rising[rising[:, 1].argsort()]
    assert rising[0, 0] > rising[-1, 0] + 40
    assert 0 <= rising[:, 1].min() and rising[:, 1].max() < 260
    assert 24 <= rising[:, 0].min() and rising[:, 0].max() < STRIP_HEIGHT


def test_draw_goal_strip_keeps_the_line_inside_when_scores_exceed_one():
    high = pixels(draw_goal_strip([0.0, 40.0, -3.0], []), BLUE)
    assert 24 <= high[:, 0].min() and high[:, 0].max() < STRIP_HEIGHT


def test_draw_goal_strip_puts_clauses_on_the_left_when_there_are_no_scores():
    strip = draw_goal_strip([], [("cart < 0.5", True)])
    assert pixels(strip, GREEN)[:, 1].max() < 60 and len(pixels(strip, BLUE)) == 0


def test_draw_goal_strip_counts_clauses_in_the_last_row_when_there_are_many():
    clauses = [("a very long clause " * 10, index % 2 == 0) for index in range(9)]
    assert draw_goal_strip([], clauses).shape == draw_goal_strip([], []).shape == (STRIP_HEIGHT, 520, 3)
    assert len({row // 24 for row in pixels(draw_goal_strip([], clauses), GREEN)[:, 0]}) == 2


def test_compose_frame_puts_the_strip_below_everything_else():
    real = np.zeros((256, 256, 3), np.uint8)
    plain, strip = compose_frame(real, None, ["return 1"]), np.full((STRIP_HEIGHT, 520, 3), BLUE, np.uint8)
    framed = compose_frame(real, None, ["return 1"], strip=strip)
    assert np.array_equal(framed[: len(plain) - 8], plain[:-8])
    assert np.array_equal(framed[-8 - STRIP_HEIGHT : -8, 8:528], strip)


def test_compose_frame_puts_the_camera_left_and_the_imagined_frame_right():
    frame = compose_frame(picture(256, (200, 0, 0)), picture(64, (0, 0, 200)), ["return 1"], horizon=6)
    left, right = np.split(frame[: PANEL_SIZE + 40], 2, axis=1)
    assert (left == (200, 0, 0)).all(axis=2).sum() == PANEL_SIZE**2
    assert (right == (0, 0, 200)).all(axis=2).sum() == PANEL_SIZE**2


@pytest.mark.parametrize("size", [64, 84, 256, 257, 300])
@pytest.mark.parametrize("imagined", [None, picture(64, (9, 9, 9))])
def test_compose_frame_returns_even_sides_with_pictures_of_at_least_256_pixels(size, imagined):
    frame = compose_frame(picture(size, (1, 2, 3)), imagined, ["one", "two"])
    assert frame.dtype == np.uint8
    assert frame.shape[0] % 2 == frame.shape[1] % 2 == 0
    assert (frame == (1, 2, 3)).all(axis=2).sum() >= PANEL_SIZE**2


def test_compose_frame_returns_the_same_size_with_and_without_a_plan():
    real = picture(256, (1, 2, 3))
    assert compose_frame(real, None, ["a"]).shape == compose_frame(real, picture(64, (9, 9, 9)), ["b"], horizon=3).shape


def test_compose_frame_prints_the_horizon():
    real, imagined = picture(256, (0, 0, 0)), picture(64, (0, 0, 0))
    frames = [compose_frame(real, imagined, [], horizon=horizon) for horizon in (None, 1, 6, 12)]
    assert len({frame.tobytes() for frame in frames}) == 4


def test_compose_frame_prints_the_reason_when_there_is_no_plan():
    real = picture(256, (0, 0, 0))
    assert (compose_frame(real, None, [], absence="no plan") != compose_frame(real, None, [], absence="over")).any()


def test_compose_frame_cuts_text_that_is_too_long():
    real = picture(256, (200, 0, 0))
    long = compose_frame(real, real[::4, ::4], ["WWW" * 100, "ggg" * 100], horizon=10**40)
    assert (long == (200, 0, 0)).all(axis=2).sum() == 2 * PANEL_SIZE**2
    border = np.concatenate([long[:2].reshape(-1, 3), long[-2:].reshape(-1, 3), long[:, :4].reshape(-1, 3)])
    assert (border == long[0, 0]).all()
    assert (long[:, -4:] == long[0, 0]).all()
