"""The encoder: frames to embeddings."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import torch
from einops import rearrange
from torch import Tensor, nn
from torch.nn import functional

from latentplan.models.heads import Mlp, single_or_double, symlog

FRAME_SIZE = 64
PATCH = 4


@dataclass(frozen=True)
class Observation:
    """Frames, and numbers beside them.

    Attributes:
        frames: uint8 (rows, height, width, channel).
        vectors: float32 (rows, vector).
    """

    frames: Tensor
    vectors: Tensor

    def __len__(self) -> int:
        """The number of rows."""
        return len(self.frames)


class Encoder(nn.Module):
    """Patches of 4 x 4 pixels through one matrix product, strided convolutions, and one linear layer.

    The patches are a convolution with stride 4, written as a matrix product because CPUs compute products faster. The
    encoder reads all pixels.

    Args:
        channels: Channels of the layers.
        embedding_dim: Size of an embedding.
        frame_shape: Shape of a frame: (height, width, channel).
        vector_dim: Numbers beside a frame; an MLP reads them, and its output is added to the embedding.
        hidden_dim: Width of the hidden layers of the MLP.
    """

    def __init__(
        self,
        channels: tuple[int, ...],
        embedding_dim: int,
        frame_shape: tuple[int, int, int] = (FRAME_SIZE, FRAME_SIZE, 3),
        vector_dim: int = 0,
        hidden_dim: int = 1,
    ) -> None:
        super().__init__()
        self.patches = nn.Linear(frame_shape[2] * PATCH * PATCH, channels[0])
        self.convolutions = nn.ModuleList(
            nn.Conv2d(before, after, kernel_size=4, stride=2, padding=1) for before, after in pairwise(channels)
        )
        side = frame_shape[0] // PATCH // 2 ** (len(channels) - 1)
        self.linear = nn.Linear(channels[-1] * side * side, embedding_dim)
        if vector_dim:
            self.vectors = Mlp(vector_dim + 1, hidden_dim, embedding_dim)

    def read_vectors(self, vectors: Tensor) -> Tensor:
        """What numbers (..., vector) add to the embedding, float32 (..., embedding)."""
        # The constant input keeps the magnitude of the numbers, which the norm of the first layer would divide out.
        return self.vectors(functional.pad(symlog(vectors), (0, 1), value=1.0))

    def forward(self, frames: Tensor | Observation) -> Tensor:
        """Embeddings, float32 (rows, embedding), of uint8 frames (rows, height, width, channel)."""
        if isinstance(frames, Observation):
            embeddings: Tensor = self(frames.frames) + self.read_vectors(frames.vectors)
            return embeddings
        patches = rearrange(
            frames, "rows (height y) (width x) channel -> rows height width (y x channel)", y=PATCH, x=PATCH
        )
        tokens = functional.silu(self._project(patches))
        features = rearrange(tokens, "rows height width channel -> rows channel height width")
        for convolution in self.convolutions:
            features = functional.silu(convolution(features))
        flat = rearrange(features, "rows channel height width -> rows (height width channel)")
        return single_or_double(self.linear(flat))

    def scaled_patches(self) -> tuple[Tensor, Tensor]:
        """Weight and bias that give on pixels what the first layer gives on pixels / 255 - 0.5."""
        return self.patches.weight / 255.0, self.patches.bias - 0.5 * self.patches.weight.sum(-1)

    def _project(self, patches: Tensor) -> Tensor:
        """The first layer on pixels / 255 - 0.5; the scale and the shift are applied to the weights instead.

        Whole numbers up to 255 are exact in bfloat16, so the pixels need one conversion and no arithmetic.
        """
        weight, shift = self.scaled_patches()
        kind = patches.device.type
        dtype = torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else weight.dtype
        return functional.linear(patches.to(dtype), weight, shift)
