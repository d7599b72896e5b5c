"""What an environment takes and shows, as far as the networks have to know it."""

from __future__ import annotations

from dataclasses import dataclass

MOST_CATEGORIES = 1024


@dataclass(frozen=True)
class Spaces:
    """Facts about actions and observations beside the size of the action. The defaults mean continuous actions.

    An action is a vector of numbers in [-1, 1]. A number that stands for one of n categories is read by the part of the
    interval that it lies in: [-1, 1] has n equal parts, and category k is the part from -1 + 2k / n on.

    Attributes:
        choices: For each number of the action, its categories, at least 2; 0 for a continuous number. An empty tuple
            means that every number is continuous.
    """

    choices: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if not all(type(num) is int and (num == 0 or 2 <= num <= MOST_CATEGORIES) for num in self.choices):
            raise ValueError(
                f"choices must be 0 or numbers of categories in [2, {MOST_CATEGORIES}], got {self.choices}"
            )

    @property
    def action_choices(self) -> dict[int, tuple[float, ...]] | None:
        """For a planner, the values of each number that stands for a category; None if all are continuous."""
        values = {place: category_values(num) for place, num in enumerate(self.choices) if num}
        return values or None


def category_values(num: int) -> tuple[float, ...]:
    """The number in [-1, 1] that stands for each of `num` categories: the middle of its part of the interval."""
    return tuple((2 * category + 1) / num - 1.0 for category in range(num))
