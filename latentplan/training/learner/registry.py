"""The registry of losses: each loss has a name, a function, and the setting that weighs it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from latentplan.config import LearningConfig


class Loss(NamedTuple):
    """A registered loss.

    Attributes:
        function: Computes the loss, a scalar, from a `Prediction` or a `Behaviour`.
        scale: Name of the setting that weighs the loss; None weighs it by 1.
        is_recorded: Whether metrics.csv has a column for the loss.
        floor: Added to a relative loss before it divides itself; None for a loss that is not relative.
    """

    function: Callable[[Any], Tensor]
    scale: str | None
    is_recorded: bool
    floor: float | None


WORLD_MODEL_LOSSES: dict[str, Loss] = {}  # functions of a `Prediction`
BEHAVIOUR_LOSSES: dict[str, Loss] = {}  # functions of a `Behaviour`


def register(
    losses: dict[str, Loss],
    name: str,
    scale: str | None = None,
    *,
    is_recorded: bool = True,
    floor: float | None = None,
) -> Callable[[Callable[[Any], Tensor]], Callable[[Any], Tensor]]:
    """Returns a decorator that adds a function to one of the two dictionaries of losses.

    Args:
        losses: `WORLD_MODEL_LOSSES` or `BEHAVIOUR_LOSSES`.
        name: Name of the loss in metrics.csv and TensorBoard.
        scale: Name of the setting of `LearningConfig` that weighs the loss; None weighs it by 1.
        is_recorded: Whether the loss is written to metrics.csv and TensorBoard.
        floor: Makes the loss relative: its scale is divided by this floor plus the value of the loss. The gradient is
            then that of the logarithm of the loss, so that a squared error counts alike whatever its unit, as in the
            likelihood of a Gaussian whose variance is fitted (Rybkin et al. 2021, section 3). A relative loss may be
            one number, or several that are weighed one by one, (n,).

    Raises:
        ValueError: The name is taken, or `LearningConfig` lacks the setting.
    """
    if name in WORLD_MODEL_LOSSES or name in BEHAVIOUR_LOSSES:
        raise ValueError(f"there is already a loss {name!r}")
    if scale is not None and scale not in {field.name for field in dataclasses.fields(LearningConfig)}:
        raise ValueError(f"loss {name!r} is weighed by {scale!r}, which is no setting of LearningConfig")

    def add(function: Callable[[Any], Tensor]) -> Callable[[Any], Tensor]:
        losses[name] = Loss(function, scale, is_recorded, floor)
        return function

    return add


def weighted_sum(
    losses: dict[str, Loss], inputs: Any, config: LearningConfig, mean: Callable[[Tensor], Tensor] = lambda value: value
) -> tuple[Tensor, dict[str, Tensor]]:
    """The sum of all losses, each times its scale, and the recorded losses by name, unscaled and detached.

    Args:
        losses: The losses.
        inputs: What the losses are functions of.
        config: Settings of learning, with the scales.
        mean: The mean of a value over the processes that share the batch.
    """
    parts = {name: loss.function(inputs) for name, loss in losses.items()}
    scaled = [_scale(losses[name], config, part, mean) * part for name, part in parts.items()]
    total = torch.cat([part.reshape(-1) for part in scaled]).sum()
    return total, {name: part.detach().sum() for name, part in parts.items() if losses[name].is_recorded}


def _scale(loss: Loss, config: LearningConfig, part: Tensor, mean: Callable[[Tensor], Tensor]) -> float | Tensor:
    """The factor of a loss that has a value."""
    scale: float = 1.0 if loss.scale is None else getattr(config, loss.scale)
    if loss.floor is None or part.numel() == 0:  # no message between processes about nothing
        return scale
    return scale / (loss.floor + mean(part.detach()))
