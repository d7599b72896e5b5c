"""Optimizer steps and running averages that all learners share."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Sequence
from typing import Any, TypedDict

import torch
from torch import Tensor

from latentplan.config import UserError
from latentplan.models.backend import Backend

RETURN_RANGE_RATE = 0.01
AVERAGED_SHARE = 0.1  # the average covers at most this share of all updates
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # names of <malloc.h>
_KEPT_BYTES = {_M_TRIM_THRESHOLD: 2**31 - 1, _M_MMAP_THRESHOLD: 32 * 2**20}


class OptimizerState(TypedDict):
    """What the `state_dict` of an optimizer returns."""

    state: dict[int, dict[str, Tensor]]
    param_groups: list[dict[str, Any]]


def descend(optimizer: torch.optim.Optimizer, loss: Tensor, max_norm: float, update: int) -> Tensor:
    """Makes one optimizer step on a loss with a clipped gradient.

    Returns:
        The norm of the gradient before clipping.

    Raises:
        FloatingPointError: The gradient is not finite; the message names `update`.
    """
    norm = clipped_gradient(optimizer, loss, max_norm)
    if not torch.isfinite(norm):
        raise FloatingPointError(
            f"the gradient is not finite at update {update} (loss {loss.item()}): "
            "lower the learning rate, or resume from the last save"
        )
    optimizer.step()
    return norm


def descend_if_finite(
    optimizer: torch.optim.Optimizer,
    loss: Tensor,
    max_norm: float,
    average: Callable[[list[Tensor]], None] | None = None,
) -> Tensor:
    """Makes one step of a fused optimizer without reading values back.

    A loss or a gradient that is not finite changes nothing.

    Args:
        optimizer: The optimizer.
        loss: The loss, a scalar.
        max_norm: Gradient norm at which the gradient is clipped.
        average: Averages tensors over several processes, in place; it gets the loss and then the gradients. None leaves
            them as they are.

    Returns:
        The norm of the gradient before clipping, NaN for a loss that is not finite; the step was made if and only if
        the norm is finite.
    """
    norm = clipped_gradient(optimizer, loss, max_norm, average)
    norm = torch.where(torch.isfinite(loss.detach()), norm, torch.nan)
    optimizer.found_inf = (~torch.isfinite(norm)).float()  # type: ignore[attr-defined]  # 1 skips the step
    optimizer.step()
    return norm


def clipped_gradient(
    optimizer: torch.optim.Optimizer,
    loss: Tensor,
    max_norm: float,
    average: Callable[[list[Tensor]], None] | None = None,
) -> Tensor:
    """Gives the parameters of an optimizer the gradient of a loss, clipped; returns its norm before clipping.

    The arguments are those of `descend_if_finite`.
    """
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    if average is not None:
        average([loss.detach(), *(parameter.grad for parameter in parameters if parameter.grad is not None)])
    return torch.nn.utils.clip_grad_norm_(parameters, max_norm)


def load_optimizer_state(optimizer: torch.optim.Optimizer, saved: dict[str, Any]) -> None:
    """Loads a saved state into an optimizer of the kind Adam, but keeps the optimizer's own options.

    The flag `capturable` depends on the device, and a run may resume on another device; the learning rate may have been
    edited in its settings.

    Raises:
        UserError: The state belongs to other parameters.
    """
    options = [{name: value for name, value in group.items() if name != "params"} for group in optimizer.param_groups]
    try:
        optimizer.load_state_dict(saved)
        for group, own in zip(optimizer.param_groups, options, strict=True):
            group |= own
            _check_moments(optimizer, group["params"])
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise UserError(f"the saved state of an optimizer does not fit its parameters: {str(error)[:160]}") from None


def _check_moments(optimizer: torch.optim.Optimizer, parameters: Sequence[Tensor]) -> None:
    """Raises ValueError if the moments of parameters have other names or shapes; none stand for no step so far."""
    for parameter in parameters:
        state = optimizer.state.get(parameter)
        moments = {"exp_avg": parameter.shape, "exp_avg_sq": parameter.shape, "step": torch.Size()}
        if state and {name: value.shape for name, value in state.items()} != moments:
            raise ValueError(f"a parameter of shape {tuple(parameter.shape)} has moments of other shapes")


@torch.no_grad()
def update_average(
    backend: Backend, running: Sequence[Tensor], latest: Sequence[Tensor], count: Tensor, rate: float
) -> None:
    """Updates a running average of parameters in place.

    Update number n gets the weight 10 / n, but at least `rate` and at most 1. The average therefore covers about the
    last tenth of all updates, and no more than the last 1 / rate updates.

    Args:
        backend: Computes the average.
        running: Averaged parameters.
        latest: Parameters after the latest update, in the same order.
        count: Number of updates before the latest, a scalar that increases by one. The count is a tensor on the
            parameters' device, so that a CUDA graph can record this function.
        rate: Smallest weight of the latest parameters, in [0, 1]; with 1 the average equals them.
    """
    count += 1.0
    backend.move_towards(running, latest, (1.0 / (AVERAGED_SHARE * count)).clamp(rate, 1.0))


def return_scale(range_so_far: Tensor, returns: Tensor) -> Tensor:
    """Running spread of returns between their 5th and 95th percentile, at least 1 (Hafner et al. 2023, eq. 7).

    Args:
        range_so_far: Running spread, a scalar that starts at 0; updated in place. Returns whose spread is not finite
            leave it unchanged, and make the loss not finite as well.
        returns: Returns, of any shape.
    """
    flat = returns.flatten()
    spread = torch.quantile(flat, 0.95) - torch.quantile(flat, 0.05)
    range_so_far.lerp_(torch.where(torch.isfinite(spread), spread, range_so_far), RETURN_RANGE_RATE)
    return range_so_far.clamp_min(1.0)


def keep_freed_memory() -> bool:
    """Makes the C library keep freed memory for the next update, which allocates the same large tensors again.

    By default glibc returns large blocks to the system at once, and the system clears every page before its next use
    (mallopt(3): M_MMAP_THRESHOLD, M_TRIM_THRESHOLD).

    Returns:
        Whether the C library accepted the thresholds.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if os.name == "posix" else None
    return mallopt is not None and all(mallopt(option, size) == 1 for option, size in _KEPT_BYTES.items())


def return_freed_memory() -> bool:
    """Gives the memory that the C library keeps back to the system, once (malloc_trim(3)).

    A save needs more memory for a moment than an update does; kept, that memory would be the run's to its end.

    Returns:
        Whether there was any such memory; False where the C library has no such call.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None
    return trim is not None and trim(0) == 1
