"""What rewards can be learned from."""

from __future__ import annotations

import warnings

import numpy as np

from latentplan.config import UserError
from latentplan.models.heads import LARGEST_SCALAR


class RewardCheck:
    """Refuses rewards that are no numbers, and warns once of those that add up to more than the heads can tell apart.

    Args:
        num_envs: Environments that give rewards.
        discount: Per decision.
    """

    def __init__(self, num_envs: int, discount: float) -> None:
        self.discount = discount
        self._sums = np.zeros(num_envs)
        self._has_warned = False

    def __call__(self, rewards: np.ndarray, is_first: np.ndarray) -> None:
        """Look at rewards (env,), of which some are an episode's first.

        Raises:
            UserError: One of them is not finite, as replay holds it.
        """
        with np.errstate(over="ignore"):
            is_finite = np.isfinite(np.asarray(rewards, np.float32))
        if not is_finite.all():
            raise UserError(f"the environment gave rewards that are not finite: {rewards.tolist()}")
        self._sums = rewards + self.discount * np.where(is_first, 0.0, self._sums)
        largest = float(np.abs(self._sums).max())
        if largest > LARGEST_SCALAR and not self._has_warned:
            self._has_warned = True
            said = f"rewards add up to {largest:.0f}, and returns beyond {LARGEST_SCALAR:.0f} are not told apart"
            warnings.warn(f"{said}: scale them", RuntimeWarning, stacklevel=2)
