"""Products of the search's own tensors."""

from __future__ import annotations

import torch
from torch import Tensor


def contract(pattern: str, *tensors: Tensor) -> Tensor:
    """`torch.einsum` in the tensors' own precision, also under an autocast that is meant for the model."""
    with torch.autocast(tensors[0].device.type, enabled=False):
        return torch.einsum(pattern, *tensors)
