"""The encoder: frames to embeddings."""

from __future__ import annotations

from itertools import pairwise

import torch
from einops import rearrange
from torch import Tensor, nn
from torch.nn import functional

from latentplan.models.heads import single_or_double

FRAME_SIZE = 64
PATCH = 4


class Encoder(nn.Module):
    """Patches of 4 x 4 pixels through one matrix product, strided convolutions, and one linear layer.

    The patches are a convolution with stride 4, written as a matrix product because CPUs compute products faster. The
    encoder reads all pixels.

    Args:
        channels: Channels of the layers.
        embedding_dim: Size of an embedding.
        frame_shape: Shape of a frame: (height, width, channel).
    """

    def __init__(
        self,
        channels: tuple[int, ...],
        embedding_dim: int,
        frame_shape: tuple[int, int, int] = (FRAME_SIZE, FRAME_SIZE, 3),
    ) -> None:
        super().__init__()
        self.patches = nn.Linear(frame_shape[2] * PATCH * PATCH, channels[0])
        self.convolutions = nn.ModuleList(
            nn.Conv2d(before, after, kernel_size=4, stride=2, padding=1) for before, after in pairwise(channels)
        )
        side = frame_shape[0] // PATCH // 2 ** (len(channels) - 1)
        self.linear = nn.Linear(channels[-1] * side * side, embedding_dim)

    def forward(self, frames: Tensor) -> Tensor:
        """Embeddings, float32 (rows, embedding), of uint8 frames (rows, height, width, channel)."""
        patches = rearrange(
            frames, "rows (height y) (width x) channel -> rows height width (y x channel)", y=PATCH, x=PATCH
        )
        tokens = functional.silu(self._project(patches))
        features = rearrange(tokens, "rows height width channel -> rows channel height width")
        for convolution in self.convolutions:
            features = functional.silu(convolution(features))
        flat = rearrange(features, "rows channel height width -> rows (height width channel)")
        return single_or_double(self.linear(flat))

    def _project(self, patches: Tensor) -> Tensor:
        """The first layer on pixels / 255 - 0.5; the scale and the shift are applied to the weights instead.

        Whole numbers up to 255 are exact in bfloat16, so the pixels need one conversion and no arithmetic.
        """
        weight = self.patches.weight / 255.0
        shift = self.patches.bias - 0.5 * self.patches.weight.sum(-1)
        kind = patches.device.type
        dtype = torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else weight.dtype
        return functional.linear(patches.to(dtype), weight, shift)
