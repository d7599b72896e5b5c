"""Steps that all learners share."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from latentplan.models.backend import Backend

RETURN_RANGE_RATE = 0.01
AVERAGED_SHARE = 0.1  # of all updates, that the average is over at most
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # names of <malloc.h>
_KEPT_BYTES = {_M_TRIM_THRESHOLD: 2**31 - 1, _M_MMAP_THRESHOLD: 32 * 2**20}


def descend(optimizer: torch.optim.Optimizer, loss: Tensor, max_norm: float, update: int) -> Tensor:
    """One step down a loss, its gradient clipped; the norm that it had before.

    Raises:
        FloatingPointError: The gradient is not finite, at this update.
    """
    norm = _clipped_gradient(optimizer, loss, max_norm)
    if not torch.isfinite(norm):
        told = f"the gradient is not finite at update {update} (loss {loss.item()})"
        raise FloatingPointError(f"{told}: lower the learning rate, or go on from the last save")
    optimizer.step()
    return norm


def descend_if_finite(optimizer: torch.optim.Optimizer, loss: Tensor, max_norm: float) -> Tensor:
    """`descend` of a fused optimizer that reads nothing back: a gradient that is not finite changes nothing.

    Returns:
        The norm that the gradient had before it was clipped; whether it is finite tells whether the step was taken.
    """
    norm = _clipped_gradient(optimizer, loss, max_norm)
    optimizer.found_inf = (~torch.isfinite(norm)).float()  # type: ignore[attr-defined]  # asks it to leave this step out
    optimizer.step()
    return norm


def _clipped_gradient(optimizer: torch.optim.Optimizer, loss: Tensor, max_norm: float) -> Tensor:
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    return torch.nn.utils.clip_grad_norm_(parameters, max_norm)


def take_up(optimizer: torch.optim.Optimizer, saved: dict[str, Any]) -> None:
    """Give an optimizer the state that was saved of another one; whether a graph may record it stays its own matter.

    That depends on the device, and a run may go on on another.
    """
    capturable = [group["capturable"] for group in optimizer.param_groups]
    optimizer.load_state_dict(saved)
    for group, own in zip(optimizer.param_groups, capturable, strict=True):
        group["capturable"] = own


@torch.no_grad()
def average(backend: Backend, running: Sequence[Tensor], latest: Sequence[Tensor], count: Tensor, rate: float) -> None:
    """Take the latest parameters into a running average over about the last tenth of all, and no more than 1 / rate.

    Args:
        backend: Computes the average.
        running: The average.
        latest: The parameters as they are now.
        count: How many there have been before, a scalar; grows by one. On the parameters' device, so that a CUDA graph
            can record this.
        rate: The least weight of the latest; with 1 there is no averaging.
    """
    count += 1.0
    backend.move_towards(running, latest, (1.0 / (AVERAGED_SHARE * count)).clamp(rate, 1.0))


def return_scale(range_so_far: Tensor, returns: Tensor) -> Tensor:
    """Spread of returns between their 5th and 95th percentile, at least 1; `range_so_far` follows it, smoothed from 0.

    It stays where it is when the spread is not finite; the loss of such returns is not finite either.

    Hafner et al. 2023, eq. 7.
    """
    flat = returns.flatten()
    spread = torch.quantile(flat, 0.95) - torch.quantile(flat, 0.05)
    range_so_far.lerp_(torch.where(torch.isfinite(spread), spread, range_so_far), RETURN_RANGE_RATE)
    return range_so_far.clamp_min(1.0)


def keep_freed_memory() -> bool:
    """Ask the C library to keep the memory that this process frees, for the next update; False where it cannot.

    Every update allocates the same large tensors. By default glibc hands such blocks back to the system at once, which
    then clears each page again before its next use (mallopt(3): M_MMAP_THRESHOLD, M_TRIM_THRESHOLD).
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if os.name == "posix" else None
    return mallopt is not None and all(mallopt(option, size) == 1 for option, size in _KEPT_BYTES.items())
