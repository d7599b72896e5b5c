"""Replayed frames, moved a little so that few pictures teach more."""

from __future__ import annotations

import torch
from torch import Tensor


def random_shift(frames: Tensor, pixels: int, generator: torch.Generator) -> Tensor:
    """Move each sequence by its own whole number of pixels, the border repeated (Yarats et al. 2021, section 3.1).

    All frames of a sequence move together, so that what moves within it stays true.

    Args:
        frames: (batch, time, height, width, channel).
        pixels: Largest move up, down, left or right; 0 moves nothing.
        generator: Where the moves are drawn from.

    Returns:
        Frames of the same shape.
    """
    if pixels == 0:
        return frames
    height, width = frames.shape[2:4]
    offsets = torch.randint(2 * pixels + 1, (len(frames), 2), generator=generator, device=frames.device).tolist()
    for axis in (2, 3):
        before, after = frames.narrow(axis, 0, 1), frames.narrow(axis, -1, 1)
        frames = torch.cat([before] * pixels + [frames] + [after] * pixels, axis)
    moved = [
        sequence[:, down : down + height, right : right + width]
        for sequence, (down, right) in zip(frames, offsets, strict=True)
    ]
    return torch.stack(moved)
