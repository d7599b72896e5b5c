"""An agent that acts by chance: what every other is compared with."""

from __future__ import annotations

import numpy as np


class RandomAgent:
    """Uniform actions in [-1, 1]."""

    last_source = "actor"

    def __init__(self, num_actions: int, seed: int = 0) -> None:
        self.num_actions = num_actions
        self.seed(seed)

    def seed(self, seed: int) -> None:
        """Restart the agent's random stream."""
        self._rng = np.random.default_rng(seed)

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Nothing to forget."""

    def imagine(self) -> None:
        """There is no plan to picture."""

    def act(self, frame: np.ndarray) -> np.ndarray:
        """A random action, float32 (action,), or (batch, action) for several frames."""
        shape = (self.num_actions,) if frame.ndim == 3 else (len(frame), self.num_actions)
        return self._rng.uniform(-1.0, 1.0, shape).astype(np.float32)
