"""The state of a search between two refits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils._pytree import tree_map

from latentplan.planning.search.elites import Elites


class Progress(NamedTuple):
    """The state of a search between two refits. Dim 0 of every tensor is the environment, and a finished one is frozen.

    Attributes:
        mean: Mean of the search distribution, (batch, length, action).
        var: Variance of the search distribution, (batch, length, action).
        probabilities: Probabilities of discrete values, (batch, length, discrete, value); None without discrete
            dimensions.
        elites: Elites of the last refit; None before the first.
        expected_return: Mean return of the last elites, NaN before the first refit, (batch,).
        num_nonfinite: Number of candidates so far whose return or violation was not finite, (batch,).
        iterations: Number of refits so far, (batch,).
        has_elites: Whether any candidate so far had a finite return and violation, (batch,).
    """

    mean: Tensor
    var: Tensor
    probabilities: Tensor | None
    elites: Elites | None
    expected_return: Tensor
    num_nonfinite: Tensor
    iterations: Tensor
    has_elites: Tensor

    def updated(self, mask: Tensor, new: Progress) -> Progress:
        """Returns this progress, with the environments in mask (batch,) taken from `new`."""

        def select(newer: Any, older: Any) -> Any:
            if not isinstance(newer, Tensor):
                return newer
            return torch.where(mask.reshape(-1, *[1] * (newer.ndim - 1)), newer, older)

        selected: Progress = tree_map(select, new, self)
        return selected

    def describe(self, history: Sequence[tuple[Tensor, Tensor]], stopped: str) -> dict[str, Any]:
        """Returns the diagnostics of a plan.

        Args:
            history: The elites' mean return and the mean sampling std after each refit, both (batch,).
            stopped: The reason the search ended.
        """
        none = self.expected_return.new_zeros(len(self.expected_return), 0)
        return {
            "elite_return": torch.stack([elite_return for elite_return, _ in history], dim=1) if history else none,
            "std": torch.stack([std for _, std in history], dim=1) if history else none,
            "iterations": self.iterations,
            "num_nonfinite": self.num_nonfinite,
            "is_fallback": ~self.has_elites,
            "stopped": stopped,
        }
