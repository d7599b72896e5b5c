"""True values of a body's named quantities, read from the simulator, and rewards made of them.

`latentplan.config.quantities` defines the names. The rewards of all tasks of a domain are computed from the same
physics by the suite's own formulas, so that one simulation gives the reward of each task.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from latentplan.config.quantities import scales
from latentplan.objectives.expression import evaluate
from latentplan.objectives.parser import parse_reward

if TYPE_CHECKING:
    from collections.abc import Callable

    from dm_control.mujoco import Physics


_WALKER_STAND_HEIGHT = 1.2
_WALKER_SPEEDS = (1.0, 8.0, -1.0)  # walk, run, backward
_CHEETAH_RUN_SPEED = 10.0
_REACHER_TARGET_RADII = (0.05, 0.015)  # easy, hard
_FINGER_TARGET_RADII = (0.07, 0.03)  # turn_easy, turn_hard
_FINGER_SPIN_SPEED = 15.0
_PENDULUM_COSINE = np.cos(np.deg2rad(8))


def measure(domain: str, physics: Physics) -> np.ndarray:
    """The true values of the present state in the order of `scales(domain)`, float32 (quantity,)."""
    return true_values(domain, physics).astype(np.float32)


def true_values(domain: str, physics: Physics) -> np.ndarray:
    """The true values as from `measure`, in the precision of the simulator, float64 (quantity,)."""
    return np.array(_MEASURES[domain](physics) if domain in _MEASURES else (), dtype=np.float64)


def clause_degree(shortfall: np.ndarray) -> np.ndarray:
    """The degree to which a clause is met, in [0, 1]: `dm_control.utils.rewards.tolerance` with a Gaussian sigmoid.

    Args:
        shortfall: Distance from meeting the clause in units of its margin, any shape; the clause is met at 0 and below.

    Returns:
        1 where the clause is met, 0.1 at a shortfall of 1, NaN where the shortfall is NaN; the shape of `shortfall`.
    """
    return np.asarray(_tolerance(np.asarray(shortfall), (-np.inf, 0.0), margin=1.0, sigmoid="gaussian"))


def _tolerance(*args: Any, **kwargs: Any) -> Any:
    from dm_control.utils.rewards import tolerance

    return tolerance(*args, **kwargs)


def _walker(physics: Any) -> tuple[float, ...]:
    height, speed, upright = physics.torso_height(), physics.horizontal_velocity(), physics.torso_upright()
    standing = _tolerance(height, (_WALKER_STAND_HEIGHT, np.inf), margin=_WALKER_STAND_HEIGHT / 2)
    stand = (3 * standing + (1 + upright) / 2) / 4
    moving = [stand * (5 * _speed_reward(speed, goal, abs(goal) / 2, 0.5) + 1) / 6 for goal in _WALKER_SPEEDS]
    return (height, speed, upright, stand, *moving)


def _speed_reward(speed: float, goal: float, margin: float, value_at_margin: float) -> float:
    """The suite's reward for a speed of at least `goal`, in the direction of the goal's sign."""
    bounds = (abs(goal), np.inf)
    along = float(np.sign(goal) * speed)
    return float(_tolerance(along, bounds, margin=margin, value_at_margin=value_at_margin, sigmoid="linear"))


def _cartpole(physics: Any) -> tuple[float, ...]:
    cart, cosines, pole_speeds = physics.cart_position(), physics.pole_angle_cosine(), physics.angular_vel()
    sine = physics.named.data.xmat[2:, "xz"][0]
    centered = (1 + _tolerance(cart, margin=2)) / 2
    control = _tolerance(physics.control(), margin=1, value_at_margin=0, sigmoid="quadratic")[0]
    slow = (1 + _tolerance(pole_speeds, margin=5).min()) / 2
    reward = ((cosines + 1) / 2).mean() * ((4 + control) / 5) * slow * centered  # the same in balance and swingup
    angle = np.arctan2(sine, cosines[0])
    return (cart, angle, cosines[0], pole_speeds[0], physics.data.qvel[0], reward, reward)


def _cheetah(physics: Any) -> tuple[float, ...]:
    speed, torso = physics.speed(), physics.named.data.xmat["torso", "zz"]
    rewards = [
        _speed_reward(speed, goal, _CHEETAH_RUN_SPEED, 0.0) for goal in (_CHEETAH_RUN_SPEED, -_CHEETAH_RUN_SPEED)
    ]
    return (speed, physics.named.data.xpos["torso", "z"], torso, *rewards)


def _reacher(physics: Any) -> tuple[float, ...]:
    distance, finger = physics.finger_to_target_dist(), physics.named.model.geom_size["finger", 0]
    return (distance, *(float(distance <= radius + finger) for radius in _REACHER_TARGET_RADII))


def _finger(physics: Any) -> tuple[float, ...]:
    spin_speed, to_centre = physics.hinge_velocity(), float(np.linalg.norm(physics.to_target()))
    turned = (float(to_centre <= radius) for radius in _FINGER_TARGET_RADII)
    return (physics.dist_to_target(), spin_speed, float(spin_speed <= -_FINGER_SPIN_SPEED), *turned)


def _ball_in_cup(physics: Any) -> tuple[float, ...]:
    to_target = physics.ball_to_target()
    return (float(np.linalg.norm(to_target)), -to_target[1], physics.in_target())


def _pendulum(physics: Any) -> tuple[float, ...]:
    cosine, sine = physics.pole_orientation()
    reward = _tolerance(cosine, (_PENDULUM_COSINE, 1))
    return (float(np.arctan2(sine, cosine)), cosine, physics.angular_velocity()[0], reward)


_MEASURES: dict[str, Callable[[Any], tuple[float, ...]]] = {
    "walker": _walker,
    "cartpole": _cartpole,
    "cheetah": _cheetah,
    "reacher": _reacher,
    "finger": _finger,
    "ball_in_cup": _ball_in_cup,
    "pendulum": _pendulum,
}


class ObjectiveReward:
    """The reward of one control step: the value of an expression over the quantities of a body.

    Args:
        text: An expression in the language of test-time objectives, without `return`, goal images and later phases.
        domain: Domain whose quantities the expression names.

    Raises:
        UserError: The text is no such expression.
    """

    def __init__(self, text: str, domain: str) -> None:
        self._expression = parse_reward(text, scales(domain), "env.objective")
        self._names = tuple(scales(domain))

    def __call__(self, values: np.ndarray) -> float:
        """The reward for the true values of the domain's quantities, (quantity,)."""
        lookup = dict(zip(self._names, values, strict=True)).__getitem__
        return float(sum(weight * evaluate(term, lookup, clause_degree) for weight, term in self._expression.terms))
