"""Replayed frames, moved or turned so that few pictures teach more."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import affine_grid, grid_sample

from latentplan.replay import Batch


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


def random_rotation(frames: Tensor, generator: torch.Generator) -> Tensor:
    """Turn each sequence about the middle of the picture by an angle of its own, uniform over the circle.

    Args:
        frames: uint8 (batch, time, height, width, channel); what comes in from outside repeats the border.
        generator: Where the angles are drawn from.

    Returns:
        Frames of the same shape and type.
    """
    size, length, height, width, channels = frames.shape
    angles = 2.0 * math.pi * torch.rand(size, generator=generator, device=frames.device)
    cosines, sines, zeros = angles.cos(), angles.sin(), torch.zeros_like(angles)
    turns = torch.stack([cosines, -sines, zeros, sines, cosines, zeros], -1).view(size, 2, 3)
    pictures = frames.permute(0, 1, 4, 2, 3).flatten(1, 2).float()
    grid = affine_grid(turns, list(pictures.shape), align_corners=False)
    turned = grid_sample(pictures, grid, padding_mode="border", align_corners=False).round().to(torch.uint8)
    return turned.view(size, length, channels, height, width).permute(0, 1, 3, 4, 2)


def rotate(batch: Batch, share: float, generator: torch.Generator) -> tuple[Batch, int]:
    """Turn the first sequences of a batch, which start without a belief then: what was believed was not turned.

    Args:
        batch: Sequences in random order.
        share: Of the sequences, in [0, 1].
        generator: Where the angles are drawn from.

    Returns:
        The batch, and how many of its sequences are turned.
    """
    count = round(share * len(batch.frames))
    if count == 0:
        return batch, 0
    frames = torch.cat([random_rotation(batch.frames[:count], generator), batch.frames[count:]])
    deter = torch.cat([torch.zeros_like(batch.deter[:count]), batch.deter[count:]])
    return batch._replace(frames=frames, deter=deter), count
