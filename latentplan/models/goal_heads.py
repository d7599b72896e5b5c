"""An actor and a value for goals that are named later: boxes in the space of the quantities."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from latentplan.models.heads import Actor, ScalarHead, action_distribution

ENDS = 2  # of an interval, each told by whether it is there, and where
CODE_SIZE = 2 * ENDS  # numbers per quantity


class GoalHeads(nn.Module):
    """What a goal makes of a latent: what to do, and what that is worth (Schaul et al. 2015).

    Args:
        in_features: Size of the features of a state.
        hidden_dim: Width of the hidden layers.
        action_dim: Size of the action.
        num_bins: Bins of the distribution of values.
        scales: Typical size of each quantity that a goal can name, (quantity,).
    """

    scales: Tensor

    def __init__(self, in_features: int, hidden_dim: int, action_dim: int, num_bins: int, scales: Tensor) -> None:
        super().__init__()
        self.register_buffer("scales", scales, persistent=False)
        self.actor = Actor(in_features + CODE_SIZE * len(scales), hidden_dim, action_dim)
        self.value_head = ScalarHead(in_features + CODE_SIZE * len(scales), hidden_dim, num_bins)

    def encode(self, low: Tensor, high: Tensor) -> Tensor:
        """Boxes as the heads read them, (..., 4 quantity), for ends (..., quantity) that are infinite where open."""
        there = [torch.isfinite(end).float() for end in (low, high)]
        where = [torch.where(torch.isfinite(end), end / self.scales, 0.0) for end in (low, high)]
        return torch.cat([there[0], where[0], there[1], where[1]], -1)

    def act(self, features: Tensor, code: Tensor, own: Tensor) -> tuple[Tensor, Tensor]:
        """Mean in [-1, 1] and std of the action.

        What is learned is what a goal changes in what the agent would do for its task (residual policy learning,
        Silver et al. 2018): a body that can swing up its pole need not learn it again.

        Args:
            features: Of states, (..., feature).
            code: Of goals, broadcasts with them.
            own: What the task's actor puts out there, (..., 2 action).
        """
        return action_distribution(own + self.actor.mlp(self._beside(features, code)))

    def judge(self, features: Tensor, code: Tensor) -> Tensor:
        """Logits of the discounted worth from there on, (..., bin)."""
        logits: Tensor = self.value_head(self._beside(features, code))
        return logits

    def value(self, features: Tensor, code: Tensor) -> Tensor:
        """Expected discounted worth from there on, (...)."""
        return self.value_head.mean(self.judge(features, code))

    @staticmethod
    def _beside(features: Tensor, code: Tensor) -> Tensor:
        return torch.cat([features, code.expand(*features.shape[:-1], code.shape[-1])], -1)
