"""Exploration noise that is correlated in time."""

from __future__ import annotations

import torch
from torch import Tensor


class CorrelatedNoise:
    """Standard normal noise, correlated with the noise of the previous decision (an AR(1) process).

    White noise hardly moves a heavy body, because pushes of successive decisions cancel each other.

    Attributes:
        last: The latest noise, (batch, action); None before the first.

    Args:
        correlation: Correlation between one decision and the next, in [0, 1).
    """

    def __init__(self, correlation: float) -> None:
        self.correlation = correlation
        self.last: Tensor | None = None

    def draw(self, like: Tensor, generator: torch.Generator, is_new: Tensor | None = None) -> Tensor:
        """The next noise, of the shape of an action (batch, action).

        Args:
            like: An action, (batch, action), for shape and device.
            generator: Random stream of the noise.
            is_new: Environments whose episode begins, (batch,) bool: their noise is independent of the past. None
                stands for no environment.
        """
        white = torch.randn(like.shape, generator=generator, device=like.device)
        noise = white
        if self.last is not None and self.correlation > 0.0:
            noise = self.correlation * self.last + (1.0 - self.correlation**2) ** 0.5 * white
            noise = noise if is_new is None else torch.where(is_new[:, None], white, noise)
        self.last = noise
        return noise

    def reset(self) -> None:
        """Forgets the latest noise of all environments."""
        self.last = None
