"""Where a search stands between two refits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils._pytree import tree_map

from latentplan.planning.search.elites import Elites


class Progress(NamedTuple):
    """Where a search stands; dim 0 of everything is the environment, so that those that are done can be frozen.

    Attributes:
        mean: Of the search distribution, (batch, horizon, action).
        var: Of the search distribution, (batch, horizon, action).
        elites: Of the last refit; None before the first.
        expected_return: Mean return of the last elites, NaN before the first, (batch,).
        num_nonfinite: Candidates so far whose return was not finite, (batch,).
        iterations: Refits so far, (batch,).
        is_found: Whether anything finite was found, (batch,).
    """

    mean: Tensor
    var: Tensor
    elites: Elites | None
    expected_return: Tensor
    num_nonfinite: Tensor
    iterations: Tensor
    is_found: Tensor

    def updated(self, mask: Tensor, new: Progress) -> Progress:
        """This, with the environments in mask (batch,) taken from `new`."""

        def choose(fresh: Any, past: Any) -> Any:
            if not isinstance(fresh, Tensor):
                return fresh
            return torch.where(mask.reshape(-1, *[1] * (fresh.ndim - 1)), fresh, past)

        chosen: Progress = tree_map(choose, new, self)
        return chosen

    def describe(self, history: Sequence[tuple[Tensor, Tensor]], stopped: str) -> dict[str, Any]:
        """The diagnostics of a plan.

        Args:
            history: After each refit, the elites' mean return and the mean sampling std, both (batch,).
            stopped: What ended the search.
        """
        none = self.expected_return.new_zeros(len(self.expected_return), 0)
        return {
            "elite_return": torch.stack([elite_return for elite_return, _ in history], dim=1) if history else none,
            "std": torch.stack([std for _, std in history], dim=1) if history else none,
            "iterations": self.iterations,
            "num_nonfinite": self.num_nonfinite,
            "is_fallback": ~self.is_found,
            "stopped": stopped,
        }
