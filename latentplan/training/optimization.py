"""Steps that all learners share."""

from __future__ import annotations

import torch
from torch import Tensor, nn

RETURN_RANGE_RATE = 0.01


def descend(optimizer: torch.optim.Optimizer, loss: Tensor, max_norm: float, update: int) -> Tensor:
    """One step down a loss, its gradient clipped; the norm that it had before.

    Raises:
        FloatingPointError: The gradient is not finite, at this update.
    """
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    norm = torch.nn.utils.clip_grad_norm_(parameters, max_norm)
    if not torch.isfinite(norm):
        raise FloatingPointError(f"the gradient is not finite at update {update} (loss {loss.item()})")
    optimizer.step()
    return norm


@torch.no_grad()
def follow(slow: nn.Module, fast: nn.Module, rate: float) -> None:
    """Move the parameters of a slow copy towards those that learn."""
    for behind, ahead in zip(slow.parameters(), fast.parameters(), strict=True):
        behind.lerp_(ahead, rate)


def return_scale(range_so_far: Tensor, returns: Tensor) -> Tensor:
    """Spread of returns between their 5th and 95th percentile, at least 1; `range_so_far` follows it, smoothed from 0.

    Hafner et al. 2023, eq. 7.
    """
    flat = returns.flatten()
    spread = torch.quantile(flat, 0.95) - torch.quantile(flat, 0.05)
    range_so_far.lerp_(spread, RETURN_RANGE_RATE)
    return range_so_far.clamp_min(1.0)
