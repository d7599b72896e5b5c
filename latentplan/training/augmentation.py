"""Replayed frames, moved a little or turned so that few pictures teach more."""

from __future__ import annotations

import torch
from torch import Tensor

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


def quarter_turns(batch: Batch, share: float, generator: torch.Generator) -> tuple[Batch, Tensor | slice]:
    """Turn the pictures of some sequences by a quarter, a half or three quarters, and forget what came before them.

    For bodies seen from above, to which every side is the same: what is learned of one place holds for four.

    Args:
        batch: Sequences; their pictures are square.
        share: Of the sequences that are turned, each as a whole, in [0, 1].
        generator: Where they are drawn from.

    Returns:
        The batch, with a belief of zeros where it is turned, and an index of the sequences that are as they were: bool
        (batch,), or a whole slice where none is turned.
    """
    if share == 0.0:
        return batch, slice(None)
    size, device = len(batch.frames), batch.frames.device
    turns = torch.randint(1, 4, (size,), generator=generator, device=device)
    is_turned = torch.rand(size, generator=generator, device=device) < share
    amounts = (turns * is_turned).tolist()
    frames = torch.stack(
        [torch.rot90(each, amount, (1, 2)) for each, amount in zip(batch.frames, amounts, strict=True)]
    )
    return batch._replace(frames=frames, deter=batch.deter * ~is_turned[:, None]), ~is_turned
