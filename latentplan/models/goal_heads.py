"""An actor and a value that take a goal as input: a box in the space of the quantities."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from latentplan.models.heads import Actor, ScalarHead, action_distribution

CODE_SIZE = 4  # numbers per quantity: for each end of its interval, whether the end exists and its position


class GoalHeads(nn.Module):
    """Actor and value conditioned on a goal (universal value functions, Schaul et al. 2015).

    Args:
        in_features: Size of a state's features.
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
        """The code of boxes, (..., 4 quantity), for their lower and upper ends (..., quantity), infinite where open."""
        exists = [torch.isfinite(end).float() for end in (low, high)]
        position = [torch.where(torch.isfinite(end), end / self.scales, 0.0) for end in (low, high)]
        return torch.cat([exists[0], position[0], exists[1], position[1]], -1)

    def act(self, features: Tensor, code: Tensor, task_output: Tensor) -> tuple[Tensor, Tensor]:
        """Mean in [-1, 1] and std of the action.

        The goal's actor adds to the output of the task's actor (residual policy learning, Silver et al. 2018), so that
        skills learned for the task need not be learned again.

        Args:
            features: Features of states, (..., feature).
            code: Codes of goals from `encode`, broadcast to the states.
            task_output: Raw output of the task's actor at these states, (..., 2 action).
        """
        return action_distribution(task_output + self.actor.mlp(self._append_code(features, code)))

    def value_logits(self, features: Tensor, code: Tensor) -> Tensor:
        """Logits of the expected discounted reward for the goal from a state on, (..., bin)."""
        logits: Tensor = self.value_head(self._append_code(features, code))
        return logits

    def value(self, features: Tensor, code: Tensor) -> Tensor:
        """The expected discounted reward for the goal from a state on, (...)."""
        return self.value_head.mean(self.value_logits(features, code))

    @staticmethod
    def _append_code(features: Tensor, code: Tensor) -> Tensor:
        return torch.cat([features, code.expand(*features.shape[:-1], code.shape[-1])], -1)
