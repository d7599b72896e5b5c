"""A frozen copy of the world model, in which behaviour imagines while the model itself learns."""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

from latentplan.models import WorldModel
from latentplan.models.heads import Mlp


class Snapshot:
    """A copy of a world model with frozen dynamics, reward and continue heads, and the same actor and value head.

    Weights of matrix products are stored in the model's `trunk_dtype`, to which autocast would convert them at every
    use. Norms and the last layers of heads stay in float32.

    Args:
        model: The world model to copy.

    Attributes:
        model: The frozen copy.
    """

    def __init__(self, model: WorldModel) -> None:
        self.model = copy.copy(model)  # shares every module
        self.model._modules = dict(model._modules)
        self._pairs: list[tuple[Tensor, Tensor]] = []
        for name in ("dynamics", "reward_head", "continue_head"):
            original = getattr(model, name)
            frozen = copy.deepcopy(original).requires_grad_(False)
            outputs = {id(part.output) for part in frozen.modules() if isinstance(part, Mlp)}
            for part in frozen.modules():
                if isinstance(part, nn.Linear) and id(part) not in outputs:
                    part.to(model.trunk_dtype)
            setattr(self.model, name, frozen)
            self._pairs += zip(frozen.parameters(), original.parameters(), strict=True)

    @torch.no_grad()
    def refresh(self) -> None:
        """Copy the present weights of the model."""
        frozen, original = zip(*self._pairs, strict=True)
        torch._foreach_copy_(list(frozen), list(original))
