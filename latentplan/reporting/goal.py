"""The strip of a film that shows how an objective is met: its worth over the last steps, and its clauses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import cv2
import numpy as np

from latentplan.reporting.video import FAINT, GAP, LINE_HEIGHT, PANEL, Frame, text_width, write_text

STRIP_HEIGHT = 4 * LINE_HEIGHT
_NUM_CLAUSES = STRIP_HEIGHT // LINE_HEIGHT
_WINDOW = 250  # env frames
_MET = (90, 200, 120)
_UNMET = (225, 100, 85)
_LINE = (120, 170, 240)


class Judge(Protocol):
    """Who keeps the score of the episode that is filmed."""

    @property
    def worth(self) -> Sequence[float]:
        """Worth of the objective at each env frame so far; empty without an objective."""

    @property
    def clauses(self) -> Sequence[tuple[str, bool]]:
        """Every clause, and whether it is met; empty before the first env frame."""


def draw_goal(width: int, worth: Sequence[float], clauses: Sequence[tuple[str, bool]]) -> Frame:
    """The strip: a trace on the left where there is an objective, the clauses beside it.

    Args:
        width: Pixels, even.
        worth: Worth of the objective at each env frame so far; the last 250 are drawn, from 0 to 1 or to the largest.
        clauses: Text of every clause and whether it is met; what exceeds four rows is counted in the last.

    Returns:
        RGB uint8 (96, width, 3).
    """
    strip: Frame = np.full((STRIP_HEIGHT, width, 3), PANEL, np.uint8)
    half = width // 2
    if worth:
        _draw_trace(strip, list(worth)[-_WINDOW:], half - 2 * GAP)
    _draw_clauses(strip, clauses, half if worth else 0)
    return strip


def _draw_clauses(strip: Frame, clauses: Sequence[tuple[str, bool]], left: int) -> None:
    width = strip.shape[1] - left - 4 * GAP
    num_shown = len(clauses) if len(clauses) <= _NUM_CLAUSES else _NUM_CLAUSES - 1
    for row, (text, is_met) in enumerate(clauses[:num_shown]):
        middle = row * LINE_HEIGHT + LINE_HEIGHT // 2
        cv2.circle(strip, (left + 2 * GAP, middle), 5, _MET if is_met else _UNMET, -1, cv2.LINE_AA)
        write_text(strip, text, left + 4 * GAP, row * LINE_HEIGHT, width - GAP)
    hidden = clauses[num_shown:]
    if hidden:
        text = f"{sum(is_met for _, is_met in hidden)} of {len(hidden)} more are met"
        write_text(strip, text, left + 4 * GAP, STRIP_HEIGHT - LINE_HEIGHT, width - GAP, FAINT)


def _draw_trace(strip: Frame, worth: Sequence[float], width: int) -> None:
    label = f"{worth[-1]:.2f}"
    write_text(strip, "objective", GAP, 0, width - text_width(label), FAINT)
    write_text(strip, label, GAP + width - text_width(label), 0, width)
    low, high = min(0.0, *worth), max(1.0, *worth)
    top, bottom = LINE_HEIGHT + 2, STRIP_HEIGHT - GAP
    cv2.line(strip, (GAP, bottom), (GAP + width, bottom), FAINT, 1)
    finite = np.nan_to_num(np.asarray(worth), nan=low)  # NaN is written above, and drawn as the lowest
    across = GAP + np.arange(len(worth)) * width / (_WINDOW - 1)
    heights = bottom - (finite - low) / (high - low) * (bottom - top)
    points = np.stack([across, heights], axis=1).round().astype(np.int32)
    cv2.polylines(strip, [points], False, _LINE, 1, cv2.LINE_AA)
