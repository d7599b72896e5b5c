"""Named quantities of each body: their meaning, their unit, and the size of a typical difference.

The scale of a quantity has two uses. It standardises the loss of the head that predicts the quantity, and it is the
margin of a clause: `height > 1.2` has the value 0.1 where the height is one scale below 1.2. The rewards of a domain's
tasks are quantities as well, named `task.stand`, `task.walk` and so on.
"""

from __future__ import annotations

from dataclasses import dataclass

TASK_PREFIX = "task."
_TASK_SCALE = 0.5


@dataclass(frozen=True)
class Quantity:
    """A number that the simulator knows and a model can learn to predict.

    Attributes:
        name: Name in expressions; `task.NAME` is the reward of a task.
        unit: Unit of the values.
        scale: Difference that matters, above 0, in the unit of the quantity.
        meaning: Description in one line.
    """

    name: str
    unit: str
    scale: float
    meaning: str


def _rewards(*tasks: str) -> tuple[Quantity, ...]:
    meaning = "reward of the task {} in one control step, in [0, 1]"
    return tuple(Quantity(TASK_PREFIX + task, "1", _TASK_SCALE, meaning.format(task)) for task in tasks)


_POLE = (
    Quantity(
        "pole_angle", "rad", 0.5, "angle of the pole from upright, in [-pi, pi]; the first pole's if there are several"
    ),
    Quantity("upright", "1", 0.5, "cosine of the pole's angle: 1 upright, -1 hanging"),
    Quantity("pole_speed", "rad/s", 2.0, "angular velocity of the pole"),
)

QUANTITIES: dict[str, tuple[Quantity, ...]] = {
    "walker": (
        Quantity("height", "m", 0.6, "height of the torso above the floor"),
        Quantity("speed", "m/s", 1.0, "horizontal velocity of the centre of mass, forwards positive"),
        Quantity("upright", "1", 0.5, "vertical part of the torso's axis: 1 upright, -1 upside down"),
        *_rewards("stand", "walk", "run", "backward"),
    ),
    "cartpole": (
        Quantity("cart", "m", 0.5, "position of the cart on its rail, 0 in the middle, the ends at -1.8 and 1.8"),
        *_POLE,
        Quantity("cart_speed", "m/s", 1.0, "velocity of the cart"),
        *_rewards("balance", "swingup"),
    ),
    "cheetah": (
        Quantity("speed", "m/s", 2.0, "horizontal velocity of the centre of mass, forwards positive"),
        Quantity("height", "m", 0.2, "height of the torso above the floor"),
        Quantity("upright", "1", 0.5, "vertical part of the torso's axis: 1 level on its feet, -1 on its back"),
        *_rewards("run", "backward"),
    ),
    "reacher": (
        Quantity("distance", "m", 0.1, "from the centre of the finger to the centre of the target"),
        *_rewards("easy", "hard"),
    ),
    "finger": (
        Quantity("distance", "m", 0.1, "from the spinner's tip to the rim of the target, negative inside it"),
        Quantity("spin_speed", "rad/s", 5.0, "angular velocity of the spinner; the task spin wants -15 or less"),
        *_rewards("spin", "turn_easy", "turn_hard"),
    ),
    "ball_in_cup": (
        Quantity("distance", "m", 0.1, "from the ball to the middle of the cup"),
        Quantity("ball_height", "m", 0.2, "height of the ball above the middle of the cup, negative below it"),
        *_rewards("catch"),
    ),
    "pendulum": (
        *_POLE,
        *_rewards("swingup"),
    ),
}


def scales(domain: str) -> dict[str, float]:
    """The scale of each quantity of a domain, in their order; empty for a domain without named quantities."""
    return {quantity.name: quantity.scale for quantity in QUANTITIES.get(domain, ())}
