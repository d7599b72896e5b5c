"""Frames of a film: the camera beside the imagined frame, lines of text, and a strip with the goals."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

Frame = NDArray[np.uint8]
Color = tuple[int, int, int]

PANEL_SIZE = 256  # smallest side of a picture, in pixels
GAP = 8
LINE_HEIGHT = 24
STRIP_HEIGHT = 4 * LINE_HEIGHT
STRIP_WIDTH = 2 * PANEL_SIZE + GAP
_BACKGROUND = (24, 24, 28)
_PANEL = (44, 44, 50)
_TEXT = (235, 235, 235)
_FAINT = (165, 165, 172)
_MET = (90, 200, 120)
_UNMET = (225, 100, 85)
_LINE = (120, 170, 240)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_MAX_CLAUSES = STRIP_HEIGHT // LINE_HEIGHT
_WINDOW = 250  # env frames in the line of scores


def compose_frame(
    real: Frame,
    imagined: Frame | None,
    lines: Sequence[str],
    *,
    horizon: int | None = None,
    absence: str = "no plan",
    strip: Frame | None = None,
) -> Frame:
    """One frame of a film: the camera on the left, the end of the plan on the right, text below.

    Args:
        real: Picture of the camera, RGB uint8 (height, width, 3); enlarged to 256 pixels if it is smaller.
        imagined: Decoded last state of the plan, RGB uint8 (height, width, 3); None without a plan.
        lines: Rows of ASCII text below the pictures; a row that is too long is cut.
        horizon: Model steps from the real frame to the imagined one.
        absence: Text on the right side without a plan.
        strip: Picture below everything else, RGB uint8 (height, width, 3), of even height, as wide as both pictures
            and the gap between them; see `draw_goal_strip`.

    Returns:
        RGB uint8 (height, width, 3), both sides even; the size depends on the sizes of `real` and `strip` and on the
        number of lines.
    """
    side = max(PANEL_SIZE, real.shape[0], real.shape[1])
    side += side % 2
    height = 2 * GAP + LINE_HEIGHT + side + LINE_HEIGHT * len(lines)
    if strip is not None:
        height += len(strip) + GAP
    canvas: Frame = np.full((height, 2 * side + 3 * GAP, 3), _BACKGROUND, np.uint8)
    top, left, right = GAP + LINE_HEIGHT, GAP, 2 * GAP + side
    canvas[top : top + side, left : left + side] = _resize(real, side)
    _write(canvas, "camera", left, GAP, side)
    if imagined is None:
        canvas[top : top + side, right : right + side] = _PANEL
        _write_centred(canvas, absence, right, top + side // 2, side)
    else:
        canvas[top : top + side, right : right + side] = _resize(imagined, side)
        _write(canvas, _horizon_label(horizon), right, GAP, side)
    for row, line in enumerate(lines):
        _write(canvas, line, left, top + side + row * LINE_HEIGHT + GAP // 2, 2 * side + GAP)
    if strip is not None:
        canvas[-GAP - len(strip) : -GAP, left : left + strip.shape[1]] = strip
    return canvas


def draw_goal_strip(scores: Sequence[float], clauses: Sequence[tuple[str, bool]]) -> Frame:
    """A strip with the goals: the scores of the objective as a line on the left, the clauses on the right.

    Args:
        scores: Score of the objective at each env frame so far; the last 250 are drawn, on a scale that includes 0 and
            1. Without scores the clauses begin on the left.
        clauses: Text of every clause, and whether the clause is met; the last of four rows counts clauses without a
            row of their own.

    Returns:
        RGB uint8 (96, 520, 3).
    """
    strip: Frame = np.full((STRIP_HEIGHT, STRIP_WIDTH, 3), _PANEL, np.uint8)
    half = STRIP_WIDTH // 2
    if scores:
        _draw_trace(strip, list(scores)[-_WINDOW:], half - 2 * GAP)
    _draw_clauses(strip, clauses, half if scores else 0)
    return strip


def _draw_clauses(strip: Frame, clauses: Sequence[tuple[str, bool]], left: int) -> None:
    width = strip.shape[1] - left - 5 * GAP
    num_shown = len(clauses) if len(clauses) <= _MAX_CLAUSES else _MAX_CLAUSES - 1
    for row, (text, is_met) in enumerate(clauses[:num_shown]):
        middle = row * LINE_HEIGHT + LINE_HEIGHT // 2
        cv2.circle(strip, (left + 2 * GAP, middle), 5, _MET if is_met else _UNMET, -1, cv2.LINE_AA)
        _write(strip, text, left + 4 * GAP, row * LINE_HEIGHT, width)
    hidden = clauses[num_shown:]
    if hidden:
        text = f"{sum(is_met for _, is_met in hidden)} of {len(hidden)} more are met"
        _write(strip, text, left + 4 * GAP, STRIP_HEIGHT - LINE_HEIGHT, width, _FAINT)


def _draw_trace(strip: Frame, scores: Sequence[float], width: int) -> None:
    label = f"{scores[-1]:.2f}"
    _write(strip, "objective", GAP, 0, width - _text_width(label), _FAINT)
    _write(strip, label, GAP + width - _text_width(label), 0, width)
    low, high = min(0.0, *scores), max(1.0, *scores)
    top, bottom = LINE_HEIGHT + 2, STRIP_HEIGHT - GAP
    cv2.line(strip, (GAP, bottom), (GAP + width, bottom), _FAINT, 1)
    finite = np.nan_to_num(np.asarray(scores), nan=low)  # the label shows NaN, the line shows the lowest score
    across = GAP + np.arange(len(scores)) * width / (_WINDOW - 1)
    heights = bottom - (finite - low) / (high - low) * (bottom - top)
    points = np.stack([across, heights], axis=1).round().astype(np.int32)
    cv2.polylines(strip, [points], False, _LINE, 1, cv2.LINE_AA)


def _horizon_label(horizon: int | None) -> str:
    if horizon is None:
        return "imagined"
    return f"imagined, {horizon} step{'' if horizon == 1 else 's'} ahead"


def _resize(picture: Frame, side: int) -> Frame:
    if picture.shape[:2] == (side, side):
        return picture
    interpolation = cv2.INTER_AREA if max(picture.shape) > side else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(picture, (side, side), interpolation=interpolation), np.uint8)


def _write(canvas: Frame, text: str, left: int, top: int, width: int, color: Color = _TEXT) -> None:
    """Writes one row of text, cut to `width` pixels, into the band of one line height below `top`."""
    while text and _text_width(text) > width:
        text = text[:-4] + "..." if len(text) > 4 else ""
    cv2.putText(canvas, text, (left, top + LINE_HEIGHT - 8), _FONT, 0.5, color, 1, cv2.LINE_AA)


def _write_centred(canvas: Frame, text: str, left: int, middle: int, width: int) -> None:
    indent = max(0, (width - _text_width(text)) // 2)
    _write(canvas, text, left + indent, middle - LINE_HEIGHT // 2, width, _FAINT)


def _text_width(text: str) -> int:
    """Width of a row of text in pixels."""
    return int(cv2.getTextSize(text, _FONT, 0.5, 1)[0][0])
