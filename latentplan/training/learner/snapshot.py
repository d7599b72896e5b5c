"""A frozen copy of the world model, for behaviour to dream in while the model itself goes on learning."""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

from latentplan.models import WorldModel
from latentplan.models.heads import Mlp


class Snapshot:
    """The world model as it was after some update, with the actor and the value that go on learning in it.

    The weights of the trunk's products are kept in the model's `trunk_dtype`, which is what autocast would make of them
    at every use; norms and the last layers of heads stay in float32.

    Args:
        model: What is copied; the snapshot shares its actor and its value head.
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
        """Take over the weights that the model has now."""
        frozen, original = zip(*self._pairs, strict=True)
        torch._foreach_copy_(list(frozen), list(original))
