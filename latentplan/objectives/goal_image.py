"""Pictures as goals, read without torch."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from latentplan.config import UserError
from latentplan.config.extras import import_extra

GOAL_IMAGE_SIZE = 64  # pixels, as camera frames


def read_goal_image(path: str, size: int = GOAL_IMAGE_SIZE) -> NDArray[np.uint8]:
    """The image in a file, resized to a camera frame, RGB uint8 (size, size, 3).

    Raises:
        UserError: The file is missing, is not an image, or is not square.
    """
    cv2 = import_extra("cv2", "a goal image")
    try:
        if not Path(path).is_file():
            reason = "is a folder" if Path(path).is_dir() else "does not exist"
            raise UserError(f"goal image {path!r} {reason}; give a square image such as a frame of the camera")
        # OpenCV would end the process where the path is not UTF-8, so that it does not read the file itself.
        content = np.frombuffer(Path(path).read_bytes(), np.uint8)
        image = cv2.imdecode(content, cv2.IMREAD_COLOR) if len(content) else None
    except (OSError, cv2.error) as error:  # a file name or an image that is too large
        raise UserError(f"goal image {path!r} cannot be read: {' '.join(str(error).split())}") from None
    if image is None:
        raise UserError(f"goal image {path!r} is not an image that can be read; give a .png")
    if image.shape[0] != image.shape[1]:
        raise UserError(f"goal image {path!r} must be square, got {image.shape[1]} x {image.shape[0]} pixels")
    shrinks = image.shape[0] > size
    resized = cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    return np.asarray(cv2.cvtColor(resized, cv2.COLOR_BGR2RGB), np.uint8)
