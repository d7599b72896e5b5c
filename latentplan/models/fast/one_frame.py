"""Belief update and actor for one frame or a few by float32 calls of torch, where `native_frame` has no compiler.

The result equals `WorldModel.infer` followed by the actor, up to rounding. For one row the overhead of calls costs more
than the arithmetic. The weights are therefore collected once, convolutions are matrix products of patches (torch spends
most of a small convolution on its preparation), and the std of the posterior is not computed. The functions take plain
tensors, so that `latentplan.agents.export` can trace them into a program.
"""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from latentplan.models.backend import FrameFunctions
from latentplan.models.dynamics import Rssm, State
from latentplan.models.encoder import PATCH
from latentplan.models.fast import pointwise
from latentplan.models.heads import NormedLinear, action_distribution
from latentplan.models.world_model import WorldModel

KERNEL, STRIDE, PADDING = 4, 2, 1  # of the encoder's convolutions

Affine = tuple[Tensor, Tensor]  # weight (out, in) and shift (out,)
Norm = tuple[Tensor, Tensor]  # scale and shift
Hidden = tuple[Tensor, Norm]  # weight (out, in) and the norm behind it


class FrameWeights(NamedTuple):
    """The weights of belief update and actor.

    Attributes:
        patches: First layer of the encoder, on pixels in [-0.5, 0.5].
        convolutions: Convolutions of the encoder, with weights (out, y x in) that multiply patches.
        embedding: Last layer of the encoder.
        input: Input layer of the GRU, for latent and action.
        gates: Gates of the GRU.
        posterior_deter: The posterior's weights for the deterministic state, (embedding, deter).
        posterior_norm: Norm of the posterior's hidden layer.
        posterior_mean: From the posterior's hidden layer to the mean of the latent.
        actor: Hidden layers of the actor.
        action: From the actor's hidden layers to mean and raw std of the action.
    """

    patches: Affine
    convolutions: tuple[Affine, ...]
    embedding: Affine
    input: Hidden
    gates: Hidden
    posterior_deter: Tensor
    posterior_norm: Norm
    posterior_mean: Affine
    actor: tuple[Hidden, ...]
    action: Affine


class TorchFrameFunctions(FrameFunctions):
    """`FrameFunctions` by calls of this module where these are faster than the model's own."""

    def __init__(self, model: WorldModel) -> None:
        super().__init__(model)
        self._weights = convert_weights(model)

    def infer(self, state: State, action: Tensor | None, frames: Any, is_first: Tensor | None = None) -> State:
        """See `FrameFunctions.infer`."""
        return see(self._weights, self._find_deter(state, action, is_first), frames)

    def act(self, state: State) -> tuple[Tensor, Tensor]:
        """See `FrameFunctions.act`."""
        return act(self._weights, state)

    def _advance(self, state: State, action: Tensor) -> Tensor:
        return advance(self._weights, state, action)


@torch.no_grad()
def convert_weights(model: WorldModel) -> FrameWeights:
    """The weights of a world model, whose dynamics are an `Rssm`, for the functions of this module.

    On the CPU the weights share the model's memory. For this purpose the model's convolutions are converted to the
    memory format `channels_last`, which changes no value. On other devices, and of a model made in inference mode, the
    weights of convolutions are copies.
    """
    encoder, dynamics = model.encoder, cast(Rssm, model.dynamics)
    latent = dynamics.latent_dim
    output = dynamics.posterior_output
    return FrameWeights(
        patches=_get_affine(encoder.patches),
        convolutions=tuple(_get_convolution(layer) for layer in encoder.convolutions if isinstance(layer, nn.Conv2d)),
        embedding=_get_affine(encoder.linear),
        input=_get_hidden(dynamics.input),
        gates=(dynamics.gates.weight.detach(), _get_norm(dynamics.gates_norm)),
        posterior_deter=dynamics.posterior_deter.weight.detach(),
        posterior_norm=_get_norm(dynamics.posterior_norm),
        posterior_mean=(output.weight.detach()[:latent], output.bias.detach()[:latent]),
        actor=tuple(_get_hidden(layer) for layer in model.actor.mlp.trunk if isinstance(layer, NormedLinear)),
        action=_get_affine(model.actor.mlp.output),
    )


def see(weights: FrameWeights, deter: Tensor, frames: Tensor) -> State:
    """The belief with the posterior's mean for deter (rows, deter) and uint8 frames (rows, 64, 64, 3)."""
    product = functional.linear(deter, weights.posterior_deter) + _embed(weights, frames)
    return State(
        deter, functional.linear(pointwise.norm_silu(product, *weights.posterior_norm), *weights.posterior_mean)
    )


def advance(weights: FrameWeights, state: State, action: Tensor) -> Tensor:
    """The deterministic state (rows, deter) after action (rows, action) in [-1, 1]."""
    hidden = _apply_layer(torch.cat([state.stoch, action], -1), weights.input)
    weight, norm = weights.gates
    product = functional.linear(torch.cat([hidden, state.deter], -1), weight)
    return pointwise.update_deter(product, *norm, state.deter)


def act(weights: FrameWeights, state: State) -> tuple[Tensor, Tensor]:
    """Mean in [-1, 1] and std of the actor's action, (rows, action) each."""
    hidden = state.features
    for layer in weights.actor:
        hidden = _apply_layer(hidden, layer)
    return action_distribution(functional.linear(hidden, *weights.action))


def _embed(weights: FrameWeights, frames: Tensor) -> Tensor:
    """Embeddings (rows, embedding) of uint8 frames (rows, 64, 64, 3)."""
    # The size comes from `shape`, because `len` would build the number of rows into an exported program.
    rows, side, channels = frames.shape[0], frames.shape[1] // PATCH, frames.shape[3]
    patches = frames.reshape(rows, side, PATCH, side, channels * PATCH).transpose(2, 3).reshape(rows, side * side, -1)
    pixels = patches.to(weights.patches[0].dtype).mul_(1.0 / 255.0).sub_(0.5)
    tokens = functional.silu(functional.linear(pixels, *weights.patches))
    for weight, shift in weights.convolutions:
        windows = _cut_windows(tokens.reshape(rows, side, side, -1))
        tokens, side = functional.silu(functional.linear(windows, weight, shift)), side // STRIDE
    return functional.linear(tokens.reshape(rows, -1), *weights.embedding)


def _cut_windows(picture: Tensor) -> Tensor:
    """The input patch of each output of a convolution, (rows, output, y x channel), for (rows, side, side, channel)."""
    rows, side, _, channels = picture.shape
    padded = functional.pad(picture, (0, 0, PADDING, PADDING, PADDING, PADDING))
    wide, outputs = side + 2 * PADDING, side // STRIDE
    line = wide * channels
    # Each line of a window is contiguous in memory, so a window is copied in four pieces.
    windows = padded.as_strided(
        (rows, outputs, outputs, KERNEL, KERNEL * channels),
        (wide * line, STRIDE * line, STRIDE * channels, line, 1),
    )
    return windows.reshape(rows, outputs * outputs, KERNEL * KERNEL * channels)


def _apply_layer(features: Tensor, layer: Hidden) -> Tensor:
    weight, norm = layer
    return pointwise.norm_silu(functional.linear(features, weight), *norm)


def _get_convolution(layer: nn.Conv2d) -> Affine:
    assert layer.bias is not None
    if layer.weight.device.type == "cpu" and not layer.weight.is_inference():
        layer.weight.data = layer.weight.data.contiguous(memory_format=torch.channels_last)
    return layer.weight.detach().permute(0, 2, 3, 1).flatten(1), layer.bias.detach()


def _get_affine(layer: nn.Linear) -> Affine:
    return layer.weight.detach(), layer.bias.detach()


def _get_norm(layer: nn.LayerNorm) -> Norm:
    return layer.weight.detach(), layer.bias.detach()


def _get_hidden(layer: NormedLinear) -> Hidden:
    return layer.linear.weight.detach(), _get_norm(layer.norm)
