"""A check of the rewards that an environment returns."""

from __future__ import annotations

import warnings

import numpy as np

from latentplan.config import UserError
from latentplan.models.heads import LARGEST_SCALAR


class RewardCheck:
    """Refuses rewards that are not finite, and warns once if discounted sums of rewards exceed the value head's range.

    Args:
        num_envs: Number of environments.
        discount: Discount per decision.
    """

    def __init__(self, num_envs: int, discount: float) -> None:
        self.discount = discount
        self._sums = np.zeros(num_envs)
        self._has_warned = False

    def __call__(self, rewards: np.ndarray, is_first: np.ndarray) -> None:
        """Check one step's rewards.

        Args:
            rewards: Rewards of one step, (env,).
            is_first: Whether the step is the first of an episode, (env,).

        Raises:
            UserError: A reward is not finite in float32, in which replay stores it.
        """
        with np.errstate(over="ignore"):
            is_finite = np.isfinite(np.asarray(rewards, np.float32))
        if not is_finite.all():
            raise UserError(f"the environment returned rewards that are not finite: {rewards.tolist()}")
        self._sums = rewards + self.discount * np.where(is_first, 0.0, self._sums)
        largest = float(np.abs(self._sums).max())
        if largest > LARGEST_SCALAR and not self._has_warned:
            self._has_warned = True
            warnings.warn(
                f"discounted rewards add up to {largest:.0f}, but the value head represents returns up to "
                f"{LARGEST_SCALAR:.0f} only: scale the rewards down",
                RuntimeWarning,
                stacklevel=2,
            )
