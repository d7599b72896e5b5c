"""Augmentation of replayed frames: random shifts and quarter turns."""

from __future__ import annotations

import torch
from torch import Tensor

from latentplan.replay.buffer import Batch


def random_shift(frames: Tensor, pixels: int, generator: torch.Generator) -> Tensor:
    """Sequences shifted by whole pixels, with repeated borders (Yarats et al. 2021, section 3.1).

    Each sequence has one shift for all its frames, so that motion within the sequence is unchanged.

    Args:
        frames: (batch, time, height, width, channel).
        pixels: Largest shift up, down, left or right; 0 shifts nothing.
        generator: Source of the shifts.

    Returns:
        Frames of the same shape.
    """
    if pixels == 0:
        return frames
    offsets = torch.randint(2 * pixels + 1, (len(frames), 2), generator=generator, device=frames.device)
    return (shift_by_slices if frames.device.type == "cpu" else shift_by_index)(frames, offsets, pixels)


def shift_by_slices(frames: Tensor, offsets: Tensor, pixels: int) -> Tensor:
    """Frames shifted by `pixels` minus offsets (batch, 2) in [0, 2 * pixels], by copying slices: fastest on a CPU."""
    height, width = frames.shape[2:4]
    for axis in (2, 3):
        before, after = frames.narrow(axis, 0, 1), frames.narrow(axis, -1, 1)
        frames = torch.cat([before] * pixels + [frames] + [after] * pixels, axis)
    moved = [
        sequence[:, down : down + height, right : right + width]
        for sequence, (down, right) in zip(frames, offsets.tolist(), strict=True)
    ]
    return torch.stack(moved)


def shift_by_index(frames: Tensor, offsets: Tensor, pixels: int) -> Tensor:
    """The result of `shift_by_slices` without reading values back to the host, as a CUDA graph requires."""
    for axis, offset in ((2, offsets[:, 0]), (3, offsets[:, 1])):
        size = frames.shape[axis]
        places = torch.arange(size, device=frames.device) + (offset[:, None] - pixels)
        index = places.clamp(0, size - 1).view(-1, *(size if other == axis else 1 for other in range(1, frames.ndim)))
        frames = frames.gather(axis, index.expand(frames.shape))
    return frames


def quarter_turns(batch: Batch, share: float, generator: torch.Generator) -> tuple[Batch, Tensor]:
    """Some sequences turned by one, two or three quarter turns, for bodies whose task is the same from every side.

    A turned sequence starts from a belief of zeros, because its stored belief is about the unturned frames.

    Args:
        batch: Sequences with square frames.
        share: Share of the sequences that are turned, each as a whole, in [0, 1].
        generator: Source of the turns.

    Returns:
        The batch, and which sequences are not turned, bool (batch,).
    """
    size, device = len(batch.frames), batch.frames.device
    if share == 0.0:
        return batch, torch.ones(size, dtype=torch.bool, device=device)
    turns = torch.randint(1, 4, (size,), generator=generator, device=device)
    is_turned = torch.rand(size, generator=generator, device=device) < share
    frames = (turn_by_slices if device.type == "cpu" else turn_by_index)(batch.frames, turns * is_turned)
    return batch._replace(frames=frames, deter=batch.deter * ~is_turned[:, None]), ~is_turned


def turn_by_slices(frames: Tensor, amounts: Tensor) -> Tensor:
    """Frames turned by quarter turns (batch,) in [0, 3], sequence by sequence: fastest on a CPU."""
    turned = [torch.rot90(each, amount, (1, 2)) for each, amount in zip(frames, amounts.tolist(), strict=True)]
    return torch.stack(turned)


def turn_by_index(frames: Tensor, amounts: Tensor) -> Tensor:
    """The result of `turn_by_slices` without reading values back to the host, as a CUDA graph requires."""
    turned = torch.stack([torch.rot90(frames, amount, (2, 3)) for amount in range(4)])
    return turned[amounts, torch.arange(len(frames), device=frames.device)]
