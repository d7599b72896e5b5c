"""Augmented frames on a CPU: slices of one sequence after another are copied, which reads their places back."""

from __future__ import annotations

import torch
from torch import Tensor


def shift_by_slices(frames: Tensor, offsets: Tensor, pixels: int) -> Tensor:
    """`Backend.shift_frames` on a CPU."""
    height, width = frames.shape[2:4]
    for axis in (2, 3):
        before, after = frames.narrow(axis, 0, 1), frames.narrow(axis, -1, 1)
        frames = torch.cat([before] * pixels + [frames] + [after] * pixels, axis)
    moved = [
        sequence[:, down : down + height, right : right + width]
        for sequence, (down, right) in zip(frames, offsets.tolist(), strict=True)
    ]
    return torch.stack(moved)


def turn_by_slices(frames: Tensor, amounts: Tensor) -> Tensor:
    """`Backend.turn_frames` on a CPU."""
    turned = [torch.rot90(each, amount, (1, 2)) for each, amount in zip(frames, amounts.tolist(), strict=True)]
    return torch.stack(turned)
