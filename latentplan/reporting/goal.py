"""The strip of a film that shows how an objective is met: its worth over the last steps, and its clauses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import cv2
import numpy as np

from latentplan.reporting.video import FAINT, GAP, LINE_HEIGHT, PANEL, Frame, write_text

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
    """The strip: a trace on the left, the clauses on the right.

    Args:
        width: Pixels, even.
        worth: Worth of the objective at each env frame so far; the last 250 are drawn, from 0 to 1 or to the largest.
        clauses: Text of every clause and whether it is met; what exceeds four rows is counted in the last.

    Returns:
        RGB uint8 (96, width, 3).
    """
    strip: Frame = np.full((STRIP_HEIGHT, width, 3), PANEL, np.uint8)
    half = width // 2
    _draw_trace(strip, list(worth)[-_WINDOW:], half - 2 * GAP)
    rows = list(clauses)
    num_hidden = max(0, len(rows) - _NUM_CLAUSES + 1) if len(rows) > _NUM_CLAUSES else 0
    for row, (text, is_met) in enumerate(rows[: len(rows) - num_hidden]):
        middle = row * LINE_HEIGHT + LINE_HEIGHT // 2
        cv2.circle(strip, (half + GAP, middle), 5, _MET if is_met else _UNMET, -1, cv2.LINE_AA)
        write_text(strip, text, half + 3 * GAP, row * LINE_HEIGHT, half - 4 * GAP)
    if num_hidden:
        num_met = sum(is_met for _, is_met in rows[-num_hidden:])
        text = f"{num_met} of {num_hidden} more are met"
        write_text(strip, text, half + 3 * GAP, STRIP_HEIGHT - LINE_HEIGHT, half - 4 * GAP, FAINT)
    return strip


def _draw_trace(strip: Frame, worth: Sequence[float], width: int) -> None:
    if not worth:
        return
    write_text(strip, "objective", GAP, 0, width, FAINT)
    label = f"{worth[-1]:.2f}"
    write_text(strip, label, GAP + width - 12 * len(label), 0, 12 * len(label))
    low, high = min(0.0, *worth), max(1.0, *worth)
    top, bottom = LINE_HEIGHT + 2, STRIP_HEIGHT - GAP
    cv2.line(strip, (GAP, bottom), (GAP + width, bottom), FAINT, 1)
    finite = np.nan_to_num(np.asarray(worth), nan=low)  # a number that is none is written above, and drawn as nothing
    across = GAP + np.arange(len(worth)) * width / (_WINDOW - 1)
    heights = bottom - (finite - low) / (high - low) * (bottom - top)
    points = np.stack([across, heights], axis=1).round().astype(np.int32)
    cv2.polylines(strip, [points], False, _LINE, 1, cv2.LINE_AA)
