"""The decoder: features of latent states to pictures, for the reconstruction loss and for display."""

from __future__ import annotations

from itertools import pairwise

import torch
from einops import rearrange
from torch import Tensor, nn
from torch.nn import functional

from latentplan.models.encoder import FRAME_SIZE
from latentplan.models.heads import NormedLinear, single_or_double

SHRINK = 2  # each pixel of the decoded picture is the mean of SHRINK x SHRINK pixels of the frame
GRIDS = 8, 7  # tokens along a side: the first that divides the decoded picture


class Decoder(nn.Module):
    """A grid of 8 x 8 tokens, one 3 x 3 convolution over it, and a patch of 4 x 4 pixels from each token.

    The tokens read the features, which suffice for the coarse picture, and hidden layers on them: where a small thing
    is painted depends on its coordinates in a way that one product cannot compute.

    The picture has half the frame's resolution, which still shows a body and costs a quarter. Patches replace
    transposed convolutions, whose bfloat16 gradient is five times as slow on a CPU. Frames of more than 64 x 64 pixels
    have larger patches, and those of 84 x 84 pixels 7 x 7 tokens.

    Args:
        in_features: Size of the features.
        channels: Channels of the tokens.
        frame_shape: Shape of a frame: (height, width, channel).
        hidden_dim: Width of the hidden layers.
        layers: Number of hidden layers, or 0 for tokens that read the features alone.
    """

    pool: Tensor

    def __init__(
        self,
        in_features: int,
        channels: int,
        frame_shape: tuple[int, int, int] = (FRAME_SIZE, FRAME_SIZE, 3),
        hidden_dim: int = 1,
        layers: int = 0,
    ) -> None:
        super().__init__()
        self.in_features = in_features
        side = frame_shape[0] // SHRINK
        self.grid = next(grid for grid in GRIDS if side % grid == 0)
        self.patch = side // self.grid
        sizes = [in_features, *[hidden_dim] * layers]
        self.hidden = nn.Sequential(*(NormedLinear(before, after) for before, after in pairwise(sizes)))
        self.tokens = nn.Linear(in_features + (hidden_dim if layers else 0), channels * self.grid**2)
        self.mix = nn.Conv2d(channels, 4 * channels, kernel_size=3, padding=1)
        self.paint = nn.Linear(4 * channels, frame_shape[2] * self.patch**2)
        self.register_buffer("pool", _pooling(self.patch, frame_shape[2]), persistent=False)

    def widen(self, features: Tensor) -> Tensor:
        """Features (rows, in) and the last hidden layer side by side, the input of the tokens, (rows, in + hidden)."""
        if not len(self.hidden):
            return features
        return torch.cat([features, self.hidden(features).to(features.dtype)], -1)

    def forward(self, features: Tensor) -> Tensor:
        """Patches of the pictures, pixels in about [-0.5, 0.5], usually (rows, 8, 8, 48), for features (rows, in)."""
        grid = rearrange(
            self.tokens(self.widen(features)),
            "rows (height width channel) -> rows channel height width",
            height=self.grid,
            width=self.grid,
        )
        grid = functional.silu(self.mix(functional.silu(grid)))
        return self.paint(rearrange(grid, "rows channel height width -> rows height width channel"))

    def loss(self, patches: Tensor, frames: Tensor) -> Tensor:
        """Squared error summed over each picture, pixels in units of the full range, (rows,) in float32.

        Args:
            patches: Decoded patches as `forward` returns them, (rows, 8, 8, 48).
            frames: The true pictures, uint8 (rows, height, width, channel).
        """
        side = self.patch * SHRINK
        pixels = rearrange(
            frames, "rows (height y) (width x) channel -> rows height width (y x channel)", y=side, x=side
        )
        target = pixels.to(patches.dtype) @ self.pool.to(patches.dtype)  # a matrix product computes these means fastest
        error = single_or_double(patches) - single_or_double(target).mul_(1.0 / 255.0).sub_(0.5)
        return error.square().sum((1, 2, 3))

    def picture(self, features: Tensor) -> Tensor:
        """The decoded pictures of the first camera, uint8 (rows, height / 2, width / 2, 3)."""
        pixels = rearrange(
            self(features).float(),
            "rows height width (y x channel) -> rows (height y) (width x) channel",
            y=self.patch,
            x=self.patch,
        )[..., :3]
        return ((pixels + 0.5).clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)


def _pooling(patch: int, channels: int) -> Tensor:
    """The matrix from a frame's patch (y x channel) to its means over SHRINK x SHRINK pixels; usually (192, 48)."""
    side = torch.eye(patch).repeat_interleave(SHRINK, 0) / SHRINK
    return torch.kron(torch.kron(side, side), torch.eye(channels))
