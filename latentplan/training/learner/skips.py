"""Steps that are skipped because a loss or gradient is not finite."""

from __future__ import annotations

import torch
from torch import Tensor, nn

LONGEST_STREAK = 10


class NotFiniteError(FloatingPointError):
    """So many steps in a row were skipped that a run cannot go on; the message is one line.

    Attributes:
        update: Number of updates at that time.
    """

    def __init__(self, message: str, update: int) -> None:
        super().__init__(message)
        self.update = update


class Skips(nn.Module):
    """Counts the skipped steps of one half of an update, in tensors that a CUDA graph can update.

    The counts are part of the learner's state, but the rows of a batch are not.

    Attributes:
        total: Steps skipped so far, int64 scalar.
        streak: Latest steps that were skipped without one between them that was not, int64 scalar.
        longest: Largest `streak` so far, int64 scalar.
        rows: Rows of the batch of the latest skipped step, int64 (batch, time + 1).

    Args:
        shape: Batch size and frames per sequence.
    """

    total: Tensor
    streak: Tensor
    longest: Tensor
    rows: Tensor

    def __init__(self, shape: tuple[int, int]) -> None:
        super().__init__()
        for name in ("total", "streak", "longest"):
            self.register_buffer(name, torch.zeros((), dtype=torch.long))
        self.register_buffer("rows", torch.zeros(shape, dtype=torch.long), persistent=False)

    def record(self, norm: Tensor, rows: Tensor) -> None:
        """Count a step whose gradient had this norm: the step was skipped if the norm is not finite.

        Args:
            norm: Norm of the gradient, a scalar.
            rows: Rows of the batch, (batch, time + 1).
        """
        is_skipped = ~torch.isfinite(norm.detach())
        self.total += is_skipped
        self.streak.copy_(torch.where(is_skipped, self.streak + 1, 0))
        torch.maximum(self.longest, self.streak, out=self.longest)
        self.rows.copy_(torch.where(is_skipped, rows.to(self.rows.device), self.rows))
