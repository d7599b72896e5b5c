"""Rollouts in one call of compiled C, in the precision in which the processor multiplies fastest.

This module arranges the weights in the layout that `imagine.c` reads. Sums and elementwise work are float32, so results
differ from those of torch only where torch rounds intermediate results.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from latentplan.models.fast.library import load
from latentplan.models.fast.native import MULTIPLE, TILE, allocate, find_kernels, pad

if TYPE_CHECKING:
    from latentplan.models.fast.rollout import Trunk, Weights


class _Layer(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("weights", "scale", "shift")),
        *((name, ctypes.c_long) for name in ("inputs", "outputs")),
    )


class _Model(ctypes.Structure):
    _fields_ = (
        ("layers", _Layer * 13),  # input, gates, prior, mean; then three of each: reward head, actor, value head
        ("bin_values", ctypes.c_void_p),
        *((name, ctypes.c_long) for name in ("action", "latent", "deter", "hidden", "bins")),
    )


class Packed(NamedTuple):
    """The struct that compiled calls read, and the tensors to which its pointers point."""

    model: _Model
    tensors: tuple[Tensor, ...]


def pack(weights: Weights, critic: tuple[Trunk, Tensor, Tensor]) -> Packed | None:
    """Weights for compiled calls; None if the processor, the dtype or the sizes of the model do not allow them.

    Args:
        weights: Converted weights from `rollout.convert_weights`.
        critic: Trunk, logits and shift of the value head, in the form that `weights` has for the reward head.
    """
    kernels = find_kernels(torch.float32)
    (action, hidden), latent, deter = weights.action.shape, len(weights.stoch), len(weights.prior)
    fit = all(size % MULTIPLE == 0 for size in (latent, deter, hidden))
    if kernels is None or not fit or weights.gates.device.type != "cpu" or weights.gates.dtype != kernels.half:
        return None
    half = kernels.half

    def rotate(matrix: Tensor, first: int) -> Tensor:
        """The rows from `first` on, then the rows before: compiled calls store stoch before deter."""
        return torch.cat([matrix[first:], matrix[:first]])

    def split_output(matrix: Tensor, shift: Tensor) -> tuple[Tensor, None, Tensor]:
        """A float32 product, or two bfloat16 products: of the rounded weights, and of the rounding errors."""
        matrix, shift = pad(matrix, 1, MULTIPLE), pad(shift, 0, MULTIPLE)
        rounded = matrix.to(half)
        parts = [rounded] if half == matrix.dtype else [rounded, (matrix - rounded.float()).to(half)]
        return torch.cat(parts, 1), None, shift

    def pack_mlp(trunk: Trunk, matrix: Tensor, shift: Tensor) -> list[tuple[Tensor, Tensor | None, Tensor]]:
        (first, first_norm), (second, second_norm) = trunk
        return [(rotate(first, deter), *first_norm), (second, *second_norm), split_output(matrix, shift)]

    layers = [
        (torch.cat([pad(weights.action, 0, MULTIPLE), weights.stoch]), *weights.input_norm),
        (rotate(weights.gates, hidden), *weights.gates_norm),
        (weights.prior, *weights.prior_norm),
        (weights.mean, None, weights.mean_shift.float()),
        *pack_mlp(weights.head, weights.logits, weights.logits_shift),
        *pack_mlp(weights.actor, weights.actor_output, weights.actor_shift),
        *pack_mlp(*critic),
    ]
    return _to_tiles(layers, weights.values, (action, latent, deter, hidden))


def rollout(packed: Packed, deter: Tensor, stoch: Tensor, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rewards (rows, time) along actions (rows, time, action), and the last deter and stoch, all float32."""
    rewards = allocate(*actions.shape[:2])
    deter, stoch, actions = _copy(deter), _copy(stoch), actions.float().contiguous()
    _call(packed, deter, stoch, actions, rewards)
    return rewards, deter, stoch


def propose(packed: Packed, deter: Tensor, stoch: Tensor, noise: Tensor) -> Tensor:
    """The actor's actions, float32 (rows, time, action), for standard normal draws of the same shape."""
    actions = _copy(noise)
    _call(packed, _copy(deter), _copy(stoch), actions)
    return actions


def value(packed: Packed, deter: Tensor, stoch: Tensor) -> Tensor:
    """The value of states, float32 (rows,)."""
    values = allocate(len(deter))
    _call(packed, _copy(deter), _copy(stoch), allocate(len(deter), 0, 0), values=values)
    return values


def _copy(tensor: Tensor) -> Tensor:
    """A contiguous float32 copy, which the compiled call overwrites."""
    return tensor.to(torch.float32, memory_format=torch.contiguous_format, copy=True)


def _call(
    packed: Packed,
    deter: Tensor,
    stoch: Tensor,
    actions: Tensor,
    rewards: Tensor | None = None,
    values: Tensor | None = None,
) -> None:
    library, model, (rows, time) = load(), packed.model, actions.shape[:2]
    assert library is not None
    expected = ((rows, model.deter), (rows, model.latent))
    if (deter.shape, stoch.shape) != expected or (time and actions.shape[2] != model.action):
        shapes = ", ".join(str(tuple(tensor.shape)) for tensor in (deter, stoch, actions))
        wanted = f"{expected[0]}, {expected[1]}, ({rows}, {time}, {model.action})"
        raise ValueError(f"deter, stoch and actions have shapes {shapes}; the model needs {wanted}")
    if not (deter.is_cpu and stoch.is_cpu and actions.is_cpu):
        devices = ", ".join(str(tensor.device) for tensor in (deter, stoch, actions))
        raise ValueError(f"deter, stoch and actions are on {devices}; the model needs them on the CPU")
    places = [None if tensor is None else tensor.data_ptr() for tensor in (deter, stoch, actions, rewards, values)]
    if library.imagine(ctypes.addressof(packed.model), *places, rows, time, torch.get_num_threads()):
        raise MemoryError(f"not enough memory for a rollout of {rows} rows")


def _to_tiles(
    layers: Sequence[tuple[Tensor, Tensor | None, Tensor]], values: Tensor, sizes: tuple[int, int, int, int]
) -> Packed:
    built, kept = [], [values]
    for matrix, scale, shift in layers:
        inputs, outputs = matrix.shape
        pair = 4 // matrix.element_size()  # neighbouring rows of weights share a place in a tile, as in products.h
        tiles = matrix.view(inputs // pair, pair, outputs // TILE, TILE).permute(2, 0, 3, 1).contiguous()
        kept += [tiles, shift] if scale is None else [tiles, scale, shift]
        built.append(
            _Layer(tiles.data_ptr(), None if scale is None else scale.data_ptr(), shift.data_ptr(), inputs, outputs)
        )
    return Packed(_Model((_Layer * len(built))(*built), values.data_ptr(), *sizes, len(values)), tuple(kept))
