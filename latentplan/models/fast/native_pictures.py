"""Encoder and decoder in one compiled call each way, for processors.

`encoder.c` and `decoder.c` compute frame after frame in the cache. A convolution is a product of rows, each of which
holds the inputs of one place.
"""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor, nn

from latentplan.models.decoder import Decoder
from latentplan.models.encoder import FRAME_SIZE, Encoder
from latentplan.models.fast.native import (
    CPU,
    LONGEST_ROW,
    TILE,
    Count,
    Layer,
    Place,
    allocate,
    borrow,
    check_called,
    check_shape,
    describe_layer,
    fits,
    give_back,
    pad_size,
    point_to,
    require_kernels,
    take_kept,
)

MOST_CONVOLUTIONS = 4  # as in encoder.c


class _Convolution(ctypes.Structure):
    _fields_ = (("layer", Layer), *((name, Count) for name in ("side", "channels", "kernel", "stride")))


class _LayerGradients(ctypes.Structure):
    _fields_ = (("weights", Place), ("shift", Place))


class _Encoder(ctypes.Structure):
    _fields_ = (
        *((name, Layer) for name in ("patches", "linear")),
        ("convolutions", _Convolution * MOST_CONVOLUTIONS),
        *((name, Count) for name in ("num_convolutions", "rows")),
        *((name, Place) for name in ("frames", "embeddings", "kept")),
    )


class _EncoderGradients(ctypes.Structure):
    _fields_ = (
        ("of_embeddings", Place),
        *((name, _LayerGradients) for name in ("patches", "linear")),
        ("convolutions", _LayerGradients * MOST_CONVOLUTIONS),
    )


class _Decoder(ctypes.Structure):
    _fields_ = (
        *((name, Layer) for name in ("tokens", "paint")),
        ("mix", _Convolution),
        ("rows", Count),
        *((name, Place) for name in ("features", "frames", "errors", "kept", "differences")),
    )


class _DecoderGradients(ctypes.Structure):
    _fields_ = (
        *((name, Place) for name in ("of_errors", "of_features")),
        *((name, _LayerGradients) for name in ("tokens", "paint", "mix")),
    )


def encode(encoder: Encoder, frames: Tensor) -> Tensor:
    """Embeddings (rows, embedding) of uint8 frames (rows, 64, 64, 3); gradients reach the weights."""
    _check_frames(frames, len(frames))
    layers = [*encoder.scaled_patches(), encoder.linear.weight, encoder.linear.bias]
    for part in encoder.convolutions:
        kernel, bias = part.parameters()
        layers += [kernel.permute(0, 2, 3, 1), bias]
    embeddings: Tensor = _Encoded.apply(frames.contiguous(), *layers)
    return embeddings


def reconstruction_errors(decoder: Decoder, features: Tensor, frames: Tensor) -> Tensor:
    """Squared errors (rows,) of decoded pictures; gradients reach features (rows, feature) and weights."""
    check_shape("features", features, len(features), decoder.in_features)
    features = decoder.widen(features)
    _check_frames(frames, len(features))
    kernel, bias = decoder.mix.parameters()
    layers = [decoder.tokens.weight, decoder.tokens.bias, decoder.paint.weight, decoder.paint.bias]
    layers += [kernel.permute(0, 2, 3, 1), bias]
    errors: Tensor = _Reconstructed.apply(features, frames.contiguous(), *layers)
    return errors


def can_encode(module: nn.Module) -> bool:
    """Whether compiled functions can compute an encoder or a decoder."""
    layers = [part for part in module.modules() if isinstance(part, nn.Linear | nn.Conv2d)]
    return fits(module) and all(part.weight[0].numel() <= LONGEST_ROW for part in layers)


def _check_frames(frames: Tensor, rows: int) -> None:
    check_shape("frames", frames, rows, FRAME_SIZE, FRAME_SIZE, 3)
    if frames.dtype != torch.uint8:
        raise ValueError(f"frames must be uint8, got {frames.dtype}")


class _LayerSums:
    """Gradients of one layer, which each thread adds up on its own."""

    def __init__(self, weight: Tensor, threads: int) -> None:
        outputs, inputs = len(weight), weight[0].numel()
        height = -(-outputs // TILE) * TILE
        self.weight = weight
        self.of_weight = torch.zeros(threads, height, pad_size(inputs), dtype=weight.dtype, device=CPU)
        self.of_shift = torch.zeros(threads, outputs, dtype=weight.dtype, device=CPU)
        self.structure = _LayerGradients(self.of_weight.data_ptr(), self.of_shift.data_ptr())

    def collect(self) -> tuple[Tensor, Tensor]:
        """Gradients of the weight and of the bias."""
        outputs, inputs = len(self.weight), self.weight[0].numel()
        of_weight = self.of_weight.sum(0) if len(self.of_weight) > 1 else self.of_weight[0]
        return of_weight[:outputs, :inputs].reshape(self.weight.shape), self.of_shift.sum(0)


class _Encoded(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, frames: Tensor, *layers: Tensor) -> Tensor:
        kernels, layers = require_kernels(layers[0]), tuple(layer.contiguous() for layer in layers)
        patches, shift, linear, bias, *rest = layers
        structure = _Encoder(
            describe_layer(patches, None, shift), describe_layer(linear, None, bias), num_convolutions=len(rest) // 2
        )
        side, kept = 16, 16 * 16 * len(patches)
        for index, (weight, bias) in enumerate(zip(rest[::2], rest[1::2], strict=True)):
            structure.convolutions[index] = _describe_convolution(weight, bias, side, stride=2)
            side //= 2
            kept += side * side * len(weight)
        structure.rows = len(frames)
        embeddings = allocate(len(frames), len(linear), dtype=kernels.real)
        ctx.kept = {"kept": borrow(len(frames), kept, dtype=kernels.half)}
        point_to(structure, frames=frames, embeddings=embeddings, **ctx.kept)
        check_called(kernels.library.encode(ctypes.addressof(structure), None, torch.get_num_threads()))
        ctx.structure, ctx.kernels, ctx.layers, ctx.frames = structure, kernels, layers, frames
        return embeddings

    @staticmethod
    def backward(ctx: Any, outer: Tensor) -> tuple[Tensor | None, ...]:
        kept, threads, outer = take_kept(ctx), torch.get_num_threads(), outer.contiguous()
        gradients = _EncoderGradients()
        sums = [_LayerSums(weight, threads) for weight in ctx.layers[::2]]
        gradients.patches, gradients.linear = sums[0].structure, sums[1].structure
        for index, part in enumerate(sums[2:]):
            gradients.convolutions[index] = part.structure
        point_to(gradients, of_embeddings=outer)
        addresses = ctypes.addressof(ctx.structure), ctypes.addressof(gradients)
        check_called(ctx.kernels.library.encode(*addresses, threads))
        give_back(kept.values())
        return None, *(part for layer in sums for part in layer.collect())


class _Reconstructed(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features: Tensor, frames: Tensor, *layers: Tensor) -> Tensor:
        kernels, layers = require_kernels(layers[0]), tuple(layer.contiguous() for layer in layers)
        features = features.to(kernels.real).contiguous()
        tokens, tokens_bias, paint, paint_bias, mix, mix_bias = layers
        structure = _Decoder(
            describe_layer(tokens, None, tokens_bias),
            describe_layer(paint, None, paint_bias),
            _describe_convolution(mix, mix_bias, 8, stride=1),
            len(features),
        )
        rows, places = len(features), 8 * 8
        errors = allocate(rows, dtype=kernels.real)
        ctx.kept = {
            "kept": borrow(rows, len(tokens) + places * len(mix), dtype=kernels.half),
            "differences": borrow(rows, places, len(paint), dtype=kernels.half),
        }
        point_to(structure, features=features, frames=frames, errors=errors, **ctx.kept)
        check_called(kernels.library.decode(ctypes.addressof(structure), None, torch.get_num_threads()))
        ctx.structure, ctx.kernels, ctx.layers, ctx.given = structure, kernels, layers, (features, frames)
        return errors

    @staticmethod
    def backward(ctx: Any, outer: Tensor) -> tuple[Tensor | None, ...]:
        kept, threads = take_kept(ctx), torch.get_num_threads()
        outer, of_features = outer.contiguous(), torch.empty_like(ctx.given[0])
        sums = [_LayerSums(weight, threads) for weight in ctx.layers[::2]]
        gradients = _DecoderGradients()
        gradients.tokens, gradients.paint, gradients.mix = (part.structure for part in sums)
        point_to(gradients, of_errors=outer, of_features=of_features)
        addresses = ctypes.addressof(ctx.structure), ctypes.addressof(gradients)
        check_called(ctx.kernels.library.decode(*addresses, threads))
        give_back(kept.values())
        return of_features, None, *(part for layer in sums for part in layer.collect())


def _describe_convolution(weight: Tensor, bias: Tensor, side: int, stride: int) -> _Convolution:
    """The convolution with weights (out, kernel, kernel, in) over a grid."""
    _, kernel, _, channels = weight.shape
    return _Convolution(describe_layer(weight.flatten(1), None, bias), side, channels, kernel, stride)
