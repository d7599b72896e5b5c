"""Exploration noise that pushes for longer than one decision."""

from __future__ import annotations

import torch
from torch import Tensor


class CorrelatedNoise:
    """Standard normal noise, correlated with that of the decision before (an AR(1) process).

    White noise hardly moves a heavy body: what it pushes now it takes back at the next decision.

    Args:
        correlation: Between one decision and the next, in [0, 1).
    """

    def __init__(self, correlation: float) -> None:
        self.correlation = correlation
        self.last: Tensor | None = None

    def draw(self, like: Tensor, generator: torch.Generator, is_new: Tensor | None = None) -> Tensor:
        """The next noise, of the shape of an action (batch, action).

        Args:
            like: An action.
            generator: Where it is drawn from.
            is_new: Where an episode begins, so that nothing came before, (batch,) bool; None is nowhere.
        """
        fresh, kept = torch.randn(like.shape, generator=generator, device=like.device), self.correlation
        noise = fresh
        if self.last is not None and kept > 0.0:
            noise = kept * self.last + (1.0 - kept**2) ** 0.5 * fresh
            noise = noise if is_new is None else torch.where(is_new[:, None], fresh, noise)
        self.last = noise
        return noise

    def reset(self) -> None:
        """Nothing came before, anywhere."""
        self.last = None
