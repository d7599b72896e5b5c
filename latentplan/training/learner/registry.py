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
    """

    function: Callable[[Any], Tensor]
    scale: str | None
    is_recorded: bool


WORLD_MODEL_LOSSES: dict[str, Loss] = {}  # functions of a `Prediction`
BEHAVIOUR_LOSSES: dict[str, Loss] = {}  # functions of a `Behaviour`


def register(
    losses: dict[str, Loss], name: str, scale: str | None = None, *, is_recorded: bool = True
) -> Callable[[Callable[[Any], Tensor]], Callable[[Any], Tensor]]:
    """Returns a decorator that adds a function to one of the two dictionaries of losses.

    Args:
        losses: `WORLD_MODEL_LOSSES` or `BEHAVIOUR_LOSSES`.
        name: Name of the loss in metrics.csv and TensorBoard.
        scale: Name of the setting of `LearningConfig` that weighs the loss; None weighs it by 1.
        is_recorded: Whether the loss is written to metrics.csv and TensorBoard.

    Raises:
        ValueError: The name is taken, or `LearningConfig` lacks the setting.
    """
    if name in WORLD_MODEL_LOSSES or name in BEHAVIOUR_LOSSES:
        raise ValueError(f"there is already a loss {name!r}")
    if scale is not None and scale not in {field.name for field in dataclasses.fields(LearningConfig)}:
        raise ValueError(f"loss {name!r} is weighed by {scale!r}, which is no setting of LearningConfig")

    def add(function: Callable[[Any], Tensor]) -> Callable[[Any], Tensor]:
        losses[name] = Loss(function, scale, is_recorded)
        return function

    return add


def weighted_sum(losses: dict[str, Loss], inputs: Any, config: LearningConfig) -> tuple[Tensor, dict[str, Tensor]]:
    """The sum of all losses, each times its scale, and the recorded losses by name, unscaled and detached."""
    parts = {name: loss.function(inputs) for name, loss in losses.items()}
    scales = {name: 1.0 if loss.scale is None else getattr(config, loss.scale) for name, loss in losses.items()}
    total = torch.stack([scales[name] * part for name, part in parts.items()]).sum()
    return total, {name: part.detach() for name, part in parts.items() if losses[name].is_recorded}
