"""Augmentation of replayed frames: random shifts and quarter turns."""

from __future__ import annotations

import torch
from torch import Tensor

from latentplan.models.backend import Backend
from latentplan.replay.buffer import Batch
from latentplan.training.ranks import ALONE, Ranks


def random_shift(
    backend: Backend, frames: Tensor, pixels: int, generator: torch.Generator, ranks: Ranks = ALONE
) -> Tensor:
    """Sequences shifted by whole pixels, with repeated borders (Yarats et al. 2021, section 3.1).

    Each sequence has one shift for all its frames, so that motion within the sequence is unchanged.

    Args:
        backend: Moves the frames.
        frames: (batch, time, height, width, channel).
        pixels: Largest shift up, down, left or right; 0 shifts nothing.
        generator: Random stream of the shifts, on the frames' device.
        ranks: The processes that share the batch, which draw alike for all its sequences.

    Returns:
        Frames of the same shape.
    """
    if pixels == 0:
        return frames
    size = len(frames) * ranks.size
    offsets = torch.randint(2 * pixels + 1, (size, 2), generator=generator, device=frames.device)
    return backend.shift_frames(frames, ranks.part(offsets), pixels)


def quarter_turns(
    backend: Backend, batch: Batch, share: float, generator: torch.Generator, ranks: Ranks = ALONE
) -> tuple[Batch, Tensor]:
    """Some sequences turned by one, two or three quarter turns, for bodies whose task is the same from every side.

    A turned sequence starts from a belief of zeros, because its stored belief is about the unturned frames.

    Args:
        backend: Turns the frames.
        batch: Sequences with square frames.
        share: Probability in [0, 1] that a sequence is turned, as a whole.
        generator: Random stream of the turns, on the batch's device.
        ranks: The processes that share the batch, which draw alike for all its sequences.

    Returns:
        The batch, and which sequences are not turned, bool (batch,).
    """
    size, device = len(batch.frames), batch.frames.device
    if share == 0.0:
        return batch, torch.ones(size, dtype=torch.bool, device=device)
    amounts = ranks.part(torch.randint(1, 4, (size * ranks.size,), generator=generator, device=device))
    is_turned = ranks.part(torch.rand(size * ranks.size, generator=generator, device=device)) < share
    frames = backend.turn_frames(batch.frames, amounts * is_turned)
    return batch._replace(frames=frames, deter=batch.deter * ~is_turned[:, None]), ~is_turned
