"""Decisions about single frames in one call of compiled C, in float32.

This module packs the weights in the layout that `frame.c` reads. Results equal those of `FrameFunctions` and of
`one_frame` up to rounding.
"""

from __future__ import annotations

import ctypes
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor, nn

from latentplan.models.backend import FrameFunctions
from latentplan.models.dynamics import Rssm, State
from latentplan.models.encoder import FRAME_SIZE
from latentplan.models.fast.library import load
from latentplan.models.fast.native import TILE, Count, Place, pad
from latentplan.models.heads import NormedLinear
from latentplan.models.world_model import WorldModel

MOST_PICTURES = 5


class _Layer(ctypes.Structure):
    _fields_ = (
        *((name, Place) for name in ("weights", "bias", "scale", "shift")),
        *((name, Count) for name in ("inputs", "outputs")),
    )


class _Model(ctypes.Structure):
    _fields_ = (
        ("pictures", _Layer * MOST_PICTURES),
        *((name, _Layer) for name in ("input", "gates", "posterior", "posterior_output", "prior", "prior_output")),
        ("actor", _Layer * 3),
        *((name, Count) for name in ("num_pictures", "action", "latent", "deter", "hidden")),
    )


class _Decision(ctypes.Structure):
    _fields_ = tuple(
        (name, Place)
        for name in (
            *("deter", "stoch", "action", "is_first", "frames"),
            *("next_deter", "next_stoch", "mean", "std", "surprise", "mismatch"),
        )
    )


class _Sizes(NamedTuple):
    deter: int
    latent: int
    action: int


class NativeFrameFunctions(FrameFunctions):
    """`FrameFunctions` in compiled C, with a packed copy of the weights.

    Args:
        model: A world model that `can_pack` accepts.
    """

    def __init__(self, model: WorldModel) -> None:
        library = load()
        assert library is not None
        self._decide = library.decide
        self._model, self._kept = _pack(model)
        self._place = ctypes.addressof(self._model)
        self._sizes = _Sizes(self._model.deter, self._model.latent, self._model.action)

    @staticmethod
    def can_pack(model: WorldModel) -> bool:
        """Whether the compiled library exists and knows the model's dynamics, device and dtype.

        Tensors of inference mode are refused, because torch does not count changes of them.
        """
        parts = (model.encoder, model.dynamics, model.actor)
        weights = [parameter for part in parts for parameter in part.parameters()]
        known = all(each.device.type == "cpu" and each.dtype == torch.float32 for each in weights)
        return type(model.dynamics) is Rssm and known and not weights[0].is_inference() and load() is not None

    def infer(self, state: State, action: Tensor | None, frames: Any, is_first: Tensor | None = None) -> State:
        """See `FrameFunctions.infer`."""
        belief = self._new_belief(frames)
        self._call(state, action, is_first, frames, *belief)
        return belief

    def infer_and_act(
        self, state: State, action: Tensor | None, frames: Any, is_first: Tensor | None = None
    ) -> tuple[State, Tensor, Tensor]:
        """See `FrameFunctions.infer_and_act`."""
        belief, mean, std = self._new_belief(frames), *self._new_actions(frames)
        self._call(state, action, is_first, frames, *belief, mean, std)
        return belief, mean, std

    def infer_and_compare(
        self, state: State, action: Tensor | None, frames: Any, is_first: Tensor | None = None
    ) -> tuple[State, Tensor]:
        """See `FrameFunctions.infer_and_compare`."""
        belief, mismatch = self._new_belief(frames), self._new(len(frames))
        self._call(state, action, is_first, frames, *belief, None, None, None, mismatch)
        return belief, mismatch

    def act(self, state: State) -> tuple[Tensor, Tensor]:
        """See `FrameFunctions.act`."""
        mean, std = self._new_actions(state.deter)
        self._call(state, None, None, None, None, None, mean, std)
        return mean, std

    def surprise(self, state: State) -> Tensor:
        """See `FrameFunctions.surprise`."""
        surprise = self._new(len(state.deter))
        self._call(state, None, None, None, None, None, None, None, surprise)
        return surprise

    def _new_belief(self, rows: Tensor) -> State:
        return State(self._new(len(rows), self._sizes.deter), self._new(len(rows), self._sizes.latent))

    def _new_actions(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        return self._new(len(rows), self._sizes.action), self._new(len(rows), self._sizes.action)

    def _new(self, *shape: int) -> Tensor:
        """An uninitialized result, float32 on the CPU like the packed weights."""
        return self._kept[0].new_empty(*shape)

    def _call(
        self,
        state: State,
        action: Tensor | None,
        is_first: Tensor | None,
        frames: Tensor | None,
        *results: Tensor | None,
    ) -> None:
        """Makes a compiled call.

        Args:
            state: Beliefs, (rows, ...).
            action: Actions (rows, action), or None.
            is_first: Flags (rows,), or None.
            frames: Frames uint8 (rows, 64, 64, 3), or None.
            results: Tensors for the results of `Decision` in frame.c, in order; missing results are not computed.

        Raises:
            ValueError: An input has a wrong shape or dtype, or lies on another device than the CPU.
        """
        rows, sizes = len(state.deter), self._sizes
        given = (
            _prepare(state.deter, torch.float32, (rows, sizes.deter)),
            _prepare(state.stoch, torch.float32, (rows, sizes.latent)),
            _prepare(action, torch.float32, (rows, sizes.action)),
            _prepare(is_first, torch.bool, (rows,)),
            _prepare(frames, torch.uint8, (rows, FRAME_SIZE, FRAME_SIZE, 3)),
        )
        places = [None if tensor is None else tensor.data_ptr() for tensor in (*given, *results)]
        if self._decide(self._place, ctypes.byref(_Decision(*places)), rows, torch.get_num_threads()):
            raise MemoryError(f"not enough memory for {rows} frames")


def _prepare(tensor: Tensor | None, dtype: torch.dtype, shape: tuple[int, ...]) -> Tensor | None:
    """The tensor, contiguous and in a dtype; floating-point numbers are converted."""
    if tensor is None:
        return None
    if tensor.shape != shape or (tensor.dtype != dtype and dtype != torch.float32) or not tensor.is_cpu:
        found = f"{tensor.dtype} {tuple(tensor.shape)} on device {tensor.device}"
        raise ValueError(f"an input is {found}; the model needs {dtype} {shape} on the CPU")
    return tensor if tensor.dtype == dtype and tensor.is_contiguous() else tensor.to(dtype).contiguous()


@torch.no_grad()
def _pack(model: WorldModel) -> tuple[_Model, list[Tensor]]:
    """The struct that compiled calls read, and the tensors to which its pointers point."""
    encoder, dynamics, actor = model.encoder, cast(Rssm, model.dynamics), model.actor.mlp
    kept: list[Tensor] = []

    def keep(tensor: Tensor) -> int:
        kept.append(tensor.detach().clone(memory_format=torch.contiguous_format))
        return kept[-1].data_ptr()

    def layer(weight: Tensor, bias: Tensor | None = None, norm: nn.LayerNorm | None = None) -> _Layer:
        outputs, inputs = weight.shape
        tiles = pad(weight, 0).unflatten(0, (-1, TILE)).transpose(1, 2)
        vectors = (None if bias is None else pad(bias, 0), *((norm.weight, norm.bias) if norm else (None, None)))
        return _Layer(keep(tiles), *(None if each is None else keep(each) for each in vectors), inputs, outputs)

    def linear(module: nn.Linear) -> _Layer:
        return layer(module.weight, module.bias)

    def hidden(module: NormedLinear) -> _Layer:
        return layer(module.linear.weight, norm=module.norm)

    def convolution(module: nn.Conv2d) -> _Layer:
        by_place = module.weight.permute(0, 2, 3, 1)  # (out, y, x, in)
        return layer(pad(by_place, 3).flatten(1), module.bias)

    convolutions = [cast(nn.Conv2d, each) for each in encoder.convolutions]
    channels = convolutions[-1].out_channels if convolutions else encoder.patches.out_features
    embedding = pad(encoder.linear.weight.unflatten(1, (-1, channels)), 2).flatten(1)
    seen = torch.cat([embedding, dynamics.posterior_deter.weight], 1)
    first, second = (cast(NormedLinear, each) for each in actor.trunk)
    packed = _Model(
        pictures=(linear(encoder.patches), *map(convolution, convolutions)),
        input=hidden(dynamics.input),
        gates=layer(dynamics.gates.weight, norm=dynamics.gates_norm),
        posterior=layer(seen, encoder.linear.bias, dynamics.posterior_norm),
        posterior_output=linear(dynamics.posterior_output),
        prior=hidden(dynamics.prior_hidden),
        prior_output=linear(dynamics.prior_output),
        actor=(hidden(first), hidden(second), linear(actor.output)),
        num_pictures=1 + len(convolutions),
        action=model.action_dim,
        latent=dynamics.latent_dim,
        deter=dynamics.deter_dim,
        hidden=dynamics.input.linear.out_features,
    )
    return packed, kept
