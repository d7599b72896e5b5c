"""What an environment takes and shows, as far as the networks have to know it."""

from __future__ import annotations

from dataclasses import dataclass

FRAME_SIZES = (64, 84, 96, 128)  # sides for which encoder and decoder divide a picture without rest
MOST_CATEGORIES = 1024
MOST_CAMERAS = 16
MOST_NUMBERS = 4096  # of an action, and of the vectors beside a frame


@dataclass(frozen=True)
class Spaces:
    """Facts about actions and observations beside the size of the action.

    The defaults mean continuous actions, and one camera whose pictures have 64 x 64 pixels.

    An action is a vector of numbers in [-1, 1]. A number that stands for one of n categories is read by the part of the
    interval that it lies in: [-1, 1] has n equal parts, and category k is the part from -1 + 2k / n on.

    Attributes:
        choices: For each number of the action, its categories, at least 2; 0 for a continuous number. An empty tuple
            means that every number is continuous.
        frame_size: Side of the square pictures, in pixels; one of `FRAME_SIZES`.
        cameras: Cameras whose RGB pictures are stacked along the last axis of a frame.
        vector_dim: Numbers that the agent sees beside each frame, such as positions of joints.
    """

    choices: tuple[int, ...] = ()
    frame_size: int = FRAME_SIZES[0]
    cameras: int = 1
    vector_dim: int = 0

    def __post_init__(self) -> None:
        check_frame_size(self.frame_size)
        if type(self.cameras) is not int or not 1 <= self.cameras <= MOST_CAMERAS:
            raise ValueError(f"cameras must be a whole number in [1, {MOST_CAMERAS}], got {self.cameras}")
        if type(self.vector_dim) is not int or not 0 <= self.vector_dim <= MOST_NUMBERS:
            raise ValueError(f"vector_dim must be a whole number in [0, {MOST_NUMBERS}], got {self.vector_dim}")
        if not all(type(num) is int and (num == 0 or 2 <= num <= MOST_CATEGORIES) for num in self.choices):
            raise ValueError(
                f"choices must be 0 or numbers of categories in [2, {MOST_CATEGORIES}], got {self.choices}"
            )

    @property
    def frame_shape(self) -> tuple[int, int, int]:
        """Shape of a frame: (height, width, channel), with three channels for each camera."""
        return self.frame_size, self.frame_size, 3 * self.cameras

    @property
    def has_usual_frames(self) -> bool:
        """Whether frames are (64, 64, 3), the shape that compiled functions know."""
        return self.frame_shape == (FRAME_SIZES[0], FRAME_SIZES[0], 3)

    @property
    def action_choices(self) -> dict[int, tuple[float, ...]] | None:
        """For a planner, the values of each number that stands for a category; None if all are continuous."""
        values = {place: category_values(num) for place, num in enumerate(self.choices) if num}
        return values or None


def check_frame_size(size: object) -> None:
    """Raises ValueError for a side of pictures that is not in `FRAME_SIZES`; the message names the nearest."""
    if type(size) is not int or size not in FRAME_SIZES:
        names, nearest = ", ".join(map(str, FRAME_SIZES)), ""
        if isinstance(size, int | float):
            nearest = f"; the nearest is {min(FRAME_SIZES, key=lambda allowed: abs(allowed - size))}"
        raise ValueError(f"frame_size must be one of {names}, got {size}{nearest}")


def category_values(num: int) -> tuple[float, ...]:
    """The number in [-1, 1] that stands for each of `num` categories: the middle of its part of the interval."""
    return tuple((2 * category + 1) / num - 1.0 for category in range(num))
