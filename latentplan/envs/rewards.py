"""What rewards of an environment add up to, against the largest return that an agent can represent."""

from __future__ import annotations

import warnings

import numpy as np

from latentplan.config.learning import LARGEST_SCALAR


def choose_discount(decisions: int | None) -> float:
    """Discount whose horizon is a fifth of an episode: 0.96 at 125 decisions, 0.99 at 500."""
    return 1.0 - 5.0 / min(max(decisions or 500, 50), 1000)


class RewardCheck:
    """Warns once if discounted sums of rewards exceed the value head's range.

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
        """
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
