"""An agent that acts at random: the baseline for every other agent."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from latentplan.agents.base import Seen, frame_of

if TYPE_CHECKING:
    from latentplan.config import Config
    from latentplan.models import WorldModel


class RandomAgent:
    """Draws every action uniformly from [-1, 1].

    Args:
        num_actions: Size of an action.
        seed: Seed of the agent's own random stream.
    """

    last_source = "actor"

    def __init__(self, num_actions: int, seed: int = 0) -> None:
        self.num_actions = num_actions
        self.seed(seed)

    def seed(self, seed: int) -> None:
        """Restarts the agent's random stream."""
        self._rng = np.random.default_rng(seed)

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Does nothing: the agent has no memory."""

    def imagine(self) -> None:
        """Returns None, because the agent has no plan."""

    def act(self, frame: Seen) -> np.ndarray:
        """A random action, float32 (action,), or (batch, action) for several frames."""
        frame = frame_of(frame)
        shape = (self.num_actions,) if frame.ndim == 3 else (len(frame), self.num_actions)
        return self._rng.uniform(-1.0, 1.0, shape).astype(np.float32)


def random_agent(model: WorldModel, config: Config) -> RandomAgent:
    """A random agent with the action size of a world model; see `AgentMode.maker`."""
    return RandomAgent(model.action_dim)
