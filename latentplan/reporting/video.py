"""Films of an agent at work: the real picture beside what its plan imagines.

OpenCV's writer never raises and drops frames of the wrong size in silence, so sizes are checked on the way in and the
file is read back before it takes its name. VP9 is the one codec of the wheel that browsers play.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np
from numpy.typing import NDArray

from latentplan.config import UserError

Frame = NDArray[np.uint8]

CODECS = {".mp4": "vp09", ".webm": "VP90"}
PANEL_SIZE = 256

GAP = 8
LINE_HEIGHT = 24
_BACKGROUND = (24, 24, 28)
PANEL = (44, 44, 50)
_TEXT = (235, 235, 235)
FAINT = (165, 165, 172)
_FONT = cv2.FONT_HERSHEY_SIMPLEX


class VideoWriter:
    """Writes RGB frames to a VP9 film; the file appears, whole and checked, when the `with` block ends well.

    A block that ends with an exception leaves no file, and an older film of the same name untouched.
    """

    def __init__(self, path: str | os.PathLike[str], fps: float, size: tuple[int, int]) -> None:
        """Opens the film.

        Args:
            path: Where it goes; `.mp4` or `.webm`.
            fps: Frames per second of playback.
            size: Width and height in pixels, both even.

        Raises:
            UserError: The name has another ending.
            ValueError: The size or rate is not allowed.
            OSError: The file cannot be opened.
        """
        self.path = check_video_path(path)
        self.size = size
        self.num_frames = 0
        if min(size) < 2 or size[0] % 2 or size[1] % 2:
            raise ValueError(f"a film's width and height must be positive and even, got {size}")
        if not fps > 0:
            raise ValueError(f"fps must be above 0, got {fps}")
        # Absolute, because OpenCV takes what stands before a colon in a relative path for a protocol.
        self._partial = self.path.absolute().with_name(f".{self.path.stem}.{os.getpid()}{self.path.suffix}")
        codec = cv2.VideoWriter.fourcc(*CODECS[self.path.suffix])
        with _quiet_stderr():
            self._writer = cv2.VideoWriter(str(self._partial), cv2.CAP_FFMPEG, codec, fps, size)
        if not self._writer.isOpened():
            raise OSError(f"cannot open a film at {self.path}")

    def __enter__(self) -> VideoWriter:
        """The writer itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Finishes the film, or drops it where the block failed.

        Raises:
            OSError: The film does not hold what was written to it.
        """
        self._writer.release()
        try:
            if kind is None:
                _check_film(self._partial, self.size, self.num_frames)
                self._partial.replace(self.path)
        finally:
            self._partial.unlink(missing_ok=True)

    def write(self, frame: Frame) -> None:
        """Appends one RGB frame, uint8 (height, width, 3).

        Raises:
            ValueError: The frame is not of the film's size and type.
        """
        width, height = self.size
        if frame.shape != (height, width, 3) or frame.dtype != np.uint8:
            raise ValueError(f"the film takes uint8 {(height, width, 3)}, got {frame.dtype} {frame.shape}")
        self._writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
        self.num_frames += 1


def check_video_path(path: str | os.PathLike[str]) -> Path:
    """The path, if its ending is one that films can have.

    Raises:
        UserError: It is not.
    """
    checked = Path(path)
    if checked.suffix not in CODECS:
        raise UserError(f"a film's name must end in {' or '.join(CODECS)}, got {checked.name!r}")
    return checked


def compose_frame(
    real: Frame,
    imagined: Frame | None,
    lines: Sequence[str],
    *,
    horizon: int | None = None,
    absence: str = "no plan",
    strip: Frame | None = None,
) -> Frame:
    """One picture of a film: the real frame, the end of the plan beside it, text below.

    Args:
        real: The camera's picture, RGB uint8 (height, width, 3); enlarged where its sides are below 256.
        imagined: Decoded last state of the chosen plan, RGB uint8 (height, width, 3); None where there is no plan.
        lines: Rows of ASCII text below the pictures; what is too long is cut.
        horizon: Model steps from the real frame to the imagined one.
        absence: What the right side says where there is no plan.
        strip: What goes below everything, RGB uint8 (height, width, 3), its height even and its width that of the
            two pictures and the gap between them.

    Returns:
        RGB uint8 (height, width, 3), both sides even; the size depends on that of `real` and `strip` and the number
        of lines.
    """
    side = max(PANEL_SIZE, real.shape[0], real.shape[1])
    side += side % 2
    height = 2 * GAP + LINE_HEIGHT + side + LINE_HEIGHT * len(lines)
    if strip is not None:
        height += len(strip) + GAP
    canvas: Frame = np.full((height, 2 * side + 3 * GAP, 3), _BACKGROUND, np.uint8)
    top, left, right = GAP + LINE_HEIGHT, GAP, 2 * GAP + side
    canvas[top : top + side, left : left + side] = _enlarge(real, side)
    write_text(canvas, "camera", left, GAP, side)
    if imagined is None:
        canvas[top : top + side, right : right + side] = PANEL
        _write_centred(canvas, absence, right, top + side // 2, side)
    else:
        canvas[top : top + side, right : right + side] = _enlarge(imagined, side)
        write_text(canvas, _horizon_label(horizon), right, GAP, side)
    for row, line in enumerate(lines):
        write_text(canvas, line, left, top + side + row * LINE_HEIGHT + GAP // 2, 2 * side + GAP)
    if strip is not None:
        canvas[-GAP - len(strip) : -GAP, left : left + strip.shape[1]] = strip
    return canvas


def _horizon_label(horizon: int | None) -> str:
    if horizon is None:
        return "imagined"
    return f"imagined, {horizon} step{'' if horizon == 1 else 's'} ahead"


def _enlarge(picture: Frame, side: int) -> Frame:
    if picture.shape[:2] == (side, side):
        return picture
    interpolation = cv2.INTER_AREA if max(picture.shape) > side else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(picture, (side, side), interpolation=interpolation), np.uint8)


def write_text(canvas: Frame, text: str, left: int, top: int, width: int, color: tuple[int, int, int] = _TEXT) -> None:
    """Writes one row, cut to `width` pixels, into the band of one line height below `top`."""
    while text and text_width(text) > width:
        text = text[:-4] + "..." if len(text) > 4 else ""
    cv2.putText(canvas, text, (left, top + LINE_HEIGHT - 8), _FONT, 0.5, color, 1, cv2.LINE_AA)


def _write_centred(canvas: Frame, text: str, left: int, middle: int, width: int) -> None:
    indent = max(0, (width - text_width(text)) // 2)
    write_text(canvas, text, left + indent, middle - LINE_HEIGHT // 2, width, FAINT)


def text_width(text: str) -> int:
    """Pixels that a row takes."""
    return int(cv2.getTextSize(text, _FONT, 0.5, 1)[0][0])


def _check_film(path: Path, size: tuple[int, int], num_frames: int) -> None:
    """Reads a film back and raises OSError unless it holds `num_frames` frames of `size`."""
    if num_frames == 0:
        raise OSError("no frame was written to the film")
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        opened, first = capture.read()
        found = 0
        while opened and (found == 0 or capture.grab()):
            found += 1
    finally:
        capture.release()
    if found != num_frames:
        raise OSError(f"the film at {path.parent} kept {found} of {num_frames} frames; is the disk full?")
    if first.shape[:2] != size[::-1]:
        raise OSError(f"the film has frames of {first.shape[1::-1]}, not {size}")


@contextlib.contextmanager
def _quiet_stderr() -> Iterator[None]:
    """Mutes the process's stderr: FFmpeg remarks there, wrongly, that WebM does not know VP9's tag."""
    saved = os.dup(2)
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
