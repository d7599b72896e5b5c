"""Writer of VP9 video files, which creates a complete file or none.

OpenCV's writer raises no error and drops frames of a wrong size, so `VideoWriter` checks every frame and reads the file
back before it renames the file. VP9 is the only codec of the OpenCV wheel that browsers play.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np

from latentplan.config import UserError
from latentplan.config.checks import is_utf8
from latentplan.reporting.frame import Frame

CODECS = {".mp4": "vp09", ".webm": "VP90"}


class VideoWriter:
    """Writes RGB frames to a VP9 file, which is checked and renamed when the `with` block ends without an error.

    If the block ends with an exception, no new file remains, and an older file of the same name is kept.
    """

    def __init__(self, path: str | os.PathLike[str], fps: float, size: tuple[int, int]) -> None:
        """Opens the file.

        Args:
            path: Path of the file, `.mp4` or `.webm`.
            fps: Frames per second of playback, above 0.
            size: Width and height in pixels, both even.

        Raises:
            UserError: The name has another ending, or the path is not UTF-8.
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
        # An absolute path, because OpenCV takes text before a colon in a relative path for a protocol.
        self._partial = self.path.absolute().with_name(f".{self.path.stem}.{os.getpid()}{self.path.suffix}")
        codec = cv2.VideoWriter.fourcc(*CODECS[self.path.suffix])
        with _quiet_stderr():
            self._writer = cv2.VideoWriter(str(self._partial), cv2.CAP_FFMPEG, codec, fps, size)
        if not self._writer.isOpened():
            raise OSError(f"cannot open a film at {self.path}")

    def __enter__(self) -> VideoWriter:
        """Returns the writer."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Finishes the file, or deletes it if the block failed.

        Raises:
            OSError: The file does not hold all frames that were written.
        """
        self._writer.release()
        try:
            if kind is None:
                _check_film(self._partial, self.size, self.num_frames)
                self._partial.replace(self.path)
        finally:
            self._partial.unlink(missing_ok=True)

    def discard(self) -> None:
        """Gives the film up, and deletes what was written of it."""
        self._writer.release()
        self._partial.unlink(missing_ok=True)

    def write(self, frame: Frame) -> None:
        """Appends one RGB frame, uint8 (height, width, 3).

        Raises:
            ValueError: The size or type of the frame is not that of the film.
        """
        width, height = self.size
        if frame.shape != (height, width, 3) or frame.dtype != np.uint8:
            raise ValueError(
                f"a frame of this film must be uint8 {(height, width, 3)}, got {frame.dtype} {frame.shape}"
            )
        self._writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
        self.num_frames += 1


def check_video_path(path: str | os.PathLike[str]) -> Path:
    """The path, if a film can have it.

    Raises:
        UserError: The ending is not allowed, and the message names the allowed endings; or the path is not UTF-8.
    """
    checked = Path(path)
    if checked.suffix not in CODECS:
        raise UserError(f"a film's name must end in {' or '.join(CODECS)}, got {checked.name!r}")
    if not is_utf8(str(checked.absolute())):  # OpenCV would end the process
        raise UserError(f"a film's path must be UTF-8, got {str(checked.absolute())!r}")
    return checked


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
    """Mutes the process's stderr, where FFmpeg warns without reason that WebM does not know the tag of VP9."""
    try:
        saved = os.dup(2)
    except OSError:  # stderr is closed
        yield
        return
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)


def read_frames(path: Path, num: int) -> list[Frame]:
    """At most `num` RGB frames of a film, evenly spaced, with the first and the last one.

    Raises:
        OSError: The film cannot be read.
    """
    if not is_utf8(str(path)):  # OpenCV would end the process
        raise OSError(f"the path of the film {str(path)!r} is not UTF-8")
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    frames: list[Frame] = []
    try:
        while (read := capture.read())[0]:
            frames.append(np.asarray(read[1][..., ::-1], np.uint8))
    finally:
        capture.release()
    if not frames:
        raise OSError(f"the film {path} cannot be read")
    places = np.linspace(0, len(frames) - 1, min(num, len(frames))).round().astype(int)
    return [frames[place] for place in dict.fromkeys(places.tolist())]


def encode_gif(frames: Sequence[Frame], frame_ms: int) -> tuple[bytes, tuple[int, int]]:
    """RGB frames at half their size as an animated GIF, and its height and width.

    Args:
        frames: Frames, uint8 (height, width, 3).
        frame_ms: Milliseconds that a frame is shown.
    """
    animation = cv2.Animation()
    animation.frames = [cv2.resize(frame[..., ::-1], None, fx=0.5, fy=0.5) for frame in frames]
    animation.durations = [frame_ms] * len(frames)
    _, data = cv2.imencodeanimation(".gif", animation)
    height, width = animation.frames[0].shape[:2]
    return data.tobytes(), (height, width)
