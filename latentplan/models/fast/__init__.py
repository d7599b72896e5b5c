"""Backends that compute a world model faster than plain torch, with the same results up to rounding.

`accelerate` gives a model the backend for its device. The other modules compute for the backends; the exported
actor uses `one_frame` too.
"""

from __future__ import annotations

import torch

from latentplan.models.backend import Backend
from latentplan.models.fast.backends import CpuBackend, GpuBackend
from latentplan.models.fast.library import find_fast_dtype
from latentplan.models.world_model import WorldModel

__all__ = ["CpuBackend", "GpuBackend", "accelerate"]


def accelerate(model: WorldModel) -> WorldModel:
    """Gives a model the fastest backend that can compute it on the device of its parameters.

    A model whose dynamics no fast backend knows gets the reference, with products in the precision that is fastest on
    the device. Call this function again after the model has moved to another device.

    Returns:
        The model.
    """
    kind = model.device.type
    fast = CpuBackend if kind == "cpu" else GpuBackend if kind == "cuda" else None
    if fast is not None and fast.can_compute(model):
        model.backend = fast()
    else:
        model.backend = Backend(find_fast_dtype() if kind == "cpu" else torch.float32)
    return model
