"""Latent states back to frames: for learning, and for looking."""

from __future__ import annotations

import torch
from einops import rearrange
from torch import Tensor, nn
from torch.nn import functional

GRID = 8
PATCH = 8


class Decoder(nn.Module):
    """A grid of 8 x 8 tokens, mixed by one 3 x 3 convolution, each painting a patch of 8 x 8 pixels.

    Transposed convolutions have no fast bfloat16 gradient on the CPU; patches do, and cost a fifth.
    """

    def __init__(self, in_features: int, channels: int) -> None:
        super().__init__()
        self.tokens = nn.Linear(in_features, channels * GRID * GRID)
        self.mix = nn.Conv2d(channels, 4 * channels, kernel_size=3, padding=1)
        self.paint = nn.Linear(4 * channels, 3 * PATCH * PATCH)

    def forward(self, features: Tensor) -> Tensor:
        """Patches of the pictures, pixels in about [-0.5, 0.5], (rows, 8, 8, 192), for features (rows, in)."""
        grid = rearrange(
            self.tokens(features), "rows (height width channel) -> rows channel height width", height=GRID, width=GRID
        )
        grid = functional.silu(self.mix(functional.silu(grid)))
        return self.paint(rearrange(grid, "rows channel height width -> rows height width channel"))

    def loss(self, patches: Tensor, frames: Tensor) -> Tensor:
        """Squared error summed over each picture, pixels in units of the full range, (rows,) in float32.

        Args:
            patches: What `forward` returned, (rows, 8, 8, 192).
            frames: The true pictures, uint8 (rows, 64, 64, 3).
        """
        target = rearrange(
            frames, "rows (height y) (width x) channel -> rows height width (y x channel)", y=PATCH, x=PATCH
        )
        error = patches - target.to(patches.dtype).mul_(1.0 / 255.0).sub_(0.5)
        return error.square().sum((1, 2, 3), dtype=torch.float32)

    def picture(self, features: Tensor) -> Tensor:
        """The decoded frames as uint8 (rows, 64, 64, 3)."""
        pixels = rearrange(
            self(features).float(),
            "rows height width (y x channel) -> rows (height y) (width x) channel",
            y=PATCH,
            x=PATCH,
        )
        return ((pixels + 0.5).clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)
