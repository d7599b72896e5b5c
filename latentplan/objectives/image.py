"""Pictures of a goal."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from latentplan.config import UserError


def read_goal(path: str, size: int = 64) -> NDArray[np.uint8]:
    """The picture in a file as the agent would see it, RGB uint8 (size, size, 3).

    Raises:
        UserError: The file is missing, is no picture, or is not square.
    """
    import cv2  # when there is a picture to read: agents act without it

    try:
        if not Path(path).is_file():
            reason = "is a folder" if Path(path).is_dir() else "does not exist"
            raise UserError(f"goal image {path!r} {reason}; give a square picture such as a frame of the camera")
        picture = cv2.imread(path, cv2.IMREAD_COLOR)
    except (OSError, cv2.error) as error:  # a name or a picture beyond what can be
        raise UserError(f"goal image {path!r} cannot be read: {' '.join(str(error).split())}") from None
    if picture is None:
        raise UserError(f"goal image {path!r} is no picture that can be read; give a .png")
    if picture.shape[0] != picture.shape[1]:
        raise UserError(f"goal image {path!r} must be square, got {picture.shape[1]} x {picture.shape[0]} pixels")
    shrinks = picture.shape[0] > size
    resized = cv2.resize(picture, (size, size), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    return np.asarray(cv2.cvtColor(resized, cv2.COLOR_BGR2RGB), np.uint8)
