"""The backends for processors and for GPUs."""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable, Sequence
from operator import attrgetter
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.optim.optimizer import register_optimizer_step_post_hook

from latentplan.models.backend import Backend, FrameFunctions, lambda_return
from latentplan.models.dynamics import Gaussian, Rssm, State
from latentplan.models.fast import compiled, native, native_heads, native_pictures, native_unroll, pointwise, unroll
from latentplan.models.fast import frames as sliced_frames
from latentplan.models.fast import rollout as rollouts
from latentplan.models.fast.library import find_fast_dtype
from latentplan.models.fast.native_frame import NativeFrameFunctions
from latentplan.models.fast.one_frame import TorchFrameFunctions
from latentplan.models.heads import Actor, Mlp, ScalarHead
from latentplan.models.world_model import WorldModel

ROLLOUT_PARTS = ("dynamics", "reward_head", "value_head", "actor")
FRAME_PARTS = ("encoder", "dynamics", "actor")
_version_of = attrgetter("_version")  # a count of writes in place


class ConvertedWeights:
    """A conversion of some weights, made again when one of these weights was replaced or changed in place.

    Changes in place of `parameter.data` go unnoticed. A copy or a pickle of this object starts empty, because converted
    weights can hold pointers.

    Args:
        parts: Names of the model's modules whose weights are converted.
        convert: `convert(model, dtype)` returns the conversion for matrix products in this dtype.
    """

    def __init__(self, parts: tuple[str, ...], convert: Callable[[WorldModel, torch.dtype], Any]) -> None:
        self._parts, self._convert = parts, convert
        self._places: tuple[tuple[nn.Module | None, ...], list[tuple[dict[str, Any], str]]] | None = None
        self._kept: tuple[Hashable, Any] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_places": None, "_kept": None}

    def of(self, model: WorldModel, dtype: torch.dtype) -> Any:
        """The conversion of the model's present weights, for matrix products in a dtype."""
        parameters = self._parameters(model)
        if parameters[0].is_inference():  # torch does not count writes to such tensors
            return self._convert(model, dtype)
        key = (dtype, *map(Tensor.data_ptr, parameters), *map(_version_of, parameters))
        kept = self._kept  # read once: another thread may replace it
        if kept is None or kept[0] != key:
            _count_fused_steps()
            with torch.inference_mode(False):  # tensors made in inference mode could not be used for gradients later
                kept = self._kept = (key, self._convert(model, dtype))
        return kept[1]

    def _parameters(self, model: WorldModel) -> list[Tensor]:
        """The parameters of the parts.

        The dictionary and name of each parameter are kept, because a walk through all modules takes longer than a step.
        """
        parts, places = tuple(map(model._modules.get, self._parts)), self._places
        if places is None or places[0] != parts:
            owners = [module._parameters for part in parts if part is not None for module in part.modules()]
            places = parts, [(owner, name) for owner in owners for name, value in owner.items() if value is not None]
            self._places = places
        return [owner[name] for owner, name in places[1]]


class _ConvertingBackend(Backend):
    """Rollouts and single frames with weights that are converted once, for dynamics of class `Rssm`."""

    def __init__(self, trunk_dtype: torch.dtype) -> None:
        super().__init__(trunk_dtype)
        self._rollout_weights = ConvertedWeights(ROLLOUT_PARTS, _convert_for_rollouts)
        self._frame_functions = ConvertedWeights(FRAME_PARTS, _convert_for_frames)

    @staticmethod
    def can_compute(model: WorldModel) -> bool:
        """Whether the backend knows the model's dynamics."""
        return type(model.dynamics) is Rssm

    def rollout(self, model: WorldModel, state: State, actions: Tensor) -> tuple[Tensor, State]:
        """See `Backend.rollout`; gradients do not reach the weights."""
        return rollouts.imagine(self._weights(model), state, _rssm(model).read(actions))

    def propose(self, model: WorldModel, state: State, noise: Tensor) -> Tensor:
        """See `Backend.propose`; gradients do not reach the weights."""
        if model.has_choices:
            return super().propose(model, state, noise)
        return rollouts.propose(self._weights(model), state, noise)

    def frame_functions(self, model: WorldModel) -> FrameFunctions:
        """See `Backend.frame_functions`."""
        functions: FrameFunctions = self._frame_functions.of(model, torch.float32)
        return functions

    def _weights(self, model: WorldModel) -> rollouts.Weights:
        kind = model.device.type
        with model.trunk_precision():
            dtype = torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else torch.float32
        weights: rollouts.Weights = self._rollout_weights.of(model, dtype)
        return weights


class CpuBackend(_ConvertingBackend):
    """One compiled call for each rollout, step and value; calls of torch where there is no compiler.

    Products are bfloat16 or float32, whichever the processor computes faster. Augmented frames are copied
    slice by slice.
    """

    def __init__(self) -> None:
        super().__init__(find_fast_dtype())

    def fast_step(self, model: WorldModel, state: State, action: Tensor) -> tuple[State, Tensor]:
        """See `Backend.fast_step`."""
        if self._packed(model) is None:
            return self.step(model, state, action)
        rewards, following = self.rollout(model, state, action.unsqueeze(1))
        return following, rewards.squeeze(1)

    def value(self, model: WorldModel, state: State) -> Tensor:
        """See `Backend.value`."""
        packed = self._packed(model) if state.deter.ndim == 2 else None
        return super().value(model, state) if packed is None else compiled.value(packed, *state)

    def shift_frames(self, frames: Tensor, offsets: Tensor, pixels: int) -> Tensor:
        """See `Backend.shift_frames`."""
        return sliced_frames.shift_by_slices(frames, offsets, pixels)

    def turn_frames(self, frames: Tensor, amounts: Tensor) -> Tensor:
        """See `Backend.turn_frames`."""
        return sliced_frames.turn_by_slices(frames, amounts)

    def observe(
        self, model: WorldModel, embeddings: Tensor, actions: Tensor, deter: Tensor, noise: Tensor
    ) -> tuple[State, Gaussian]:
        """See `Backend.observe`."""
        if not native.fits(model.dynamics):
            return super().observe(model, embeddings, actions, deter, noise)
        return native_unroll.observe(_rssm(model), embeddings, _rssm(model).read(actions), deter, noise)

    def predict(self, model: WorldModel, start: State, actions: Tensor) -> tuple[Tensor, Gaussian]:
        """See `Backend.predict`; gradients do not reach the start."""
        if not native.fits(model.dynamics):
            return super().predict(model, start, actions)
        return native_unroll.predict(_rssm(model), start, _rssm(model).read(actions))

    def imagine(
        self, model: WorldModel, start: State, action_noise: Tensor, noise: Tensor, decay: float
    ) -> tuple[Tensor, Tensor]:
        """See `Backend.imagine`; the weights of the dynamics get no gradient."""
        if not (native.fits(model.dynamics) and native.fits(model.actor)):
            return super().imagine(model, start, action_noise, noise, decay)
        return native_unroll.imagine(_rssm(model), _gaussian_actor(model), start, action_noise, noise, decay)

    def encode(self, model: WorldModel, frames: Tensor) -> Tensor:
        """See `Backend.encode`."""
        if not (model.spaces.has_usual_frames and native_pictures.can_encode(model.encoder)):
            return super().encode(model, frames)
        return native_pictures.encode(model.encoder, frames)

    def reconstruction_errors(self, model: WorldModel, features: Tensor, frames: Tensor) -> Tensor:
        """See `Backend.reconstruction_errors`."""
        if not (model.spaces.has_usual_frames and native_pictures.can_encode(model.decoder)):
            return super().reconstruction_errors(model, features, frames)
        return native_pictures.reconstruction_errors(model.decoder, features, frames)

    def apply(self, network: Mlp, features: Tensor) -> Tensor:
        """See `Backend.apply`."""
        return native_heads.apply(network, features) if native.fits(network) else super().apply(network, features)

    def mean(self, head: ScalarHead, logits: Tensor) -> Tensor:
        """See `Backend.mean`."""
        return native_heads.mean(head, logits) if native.fits(head) else super().mean(head, logits)

    def cross_entropy(self, head: ScalarHead, logits: Tensor, targets: Tensor) -> Tensor:
        """See `Backend.cross_entropy`."""
        if not native.fits(head):
            return super().cross_entropy(head, logits, targets)
        return native_heads.cross_entropy(head, logits, targets)

    def lambda_return(self, rewards: Tensor, discounts: Tensor, values: Tensor, lambda_: float) -> Tensor:
        """See `Backend.lambda_return`."""
        known = rewards.device.type == "cpu" and native.find_kernels(rewards.dtype) is not None
        compute = native_heads.lambda_return if known else super().lambda_return
        return compute(rewards, discounts, values, lambda_)

    def frozen_dtype(self, model: WorldModel) -> torch.dtype:
        """See `Backend.frozen_dtype`; compiled functions read float32."""
        return torch.float32 if native.fits(model.dynamics) else self.trunk_dtype

    def _packed(self, model: WorldModel) -> compiled.Packed | None:
        """Weights for compiled calls; None if torch has to compute, or if gradients could be required."""
        return None if torch.is_grad_enabled() else self._weights(model).packed


class GpuBackend(_ConvertingBackend):
    """Fewer kernels per step: the gradients of the recurrence are written out, and elementwise work is compiled.

    The trunk is float32, because converting operands takes longer than products of this size save. For tensors on a CPU
    the same arithmetic runs uncompiled.
    """

    def __init__(self) -> None:
        super().__init__(torch.float32)

    def observe(
        self, model: WorldModel, embeddings: Tensor, actions: Tensor, deter: Tensor, noise: Tensor
    ) -> tuple[State, Gaussian]:
        """See `Backend.observe`."""
        return unroll.observe(_rssm(model), embeddings, _rssm(model).read(actions), deter, noise)

    def predict(self, model: WorldModel, start: State, actions: Tensor) -> tuple[Tensor, Gaussian]:
        """See `Backend.predict`."""
        return unroll.predict(_rssm(model), start, _rssm(model).read(actions))

    def imagine(
        self, model: WorldModel, start: State, action_noise: Tensor, noise: Tensor, decay: float
    ) -> tuple[Tensor, Tensor]:
        """See `Backend.imagine`; the weights of the dynamics get no gradient."""
        return unroll.imagine(_rssm(model), _gaussian_actor(model), start, action_noise, noise, decay)

    def lambda_return(self, rewards: Tensor, discounts: Tensor, values: Tensor, lambda_: float) -> Tensor:
        """See `Backend.lambda_return`."""
        returns: Tensor = pointwise.run(lambda_return, rewards, discounts, values, lambda_)
        return returns

    @torch.no_grad()
    def move_towards(self, slow: Sequence[Tensor], fast: Sequence[Tensor], rate: float | Tensor) -> None:
        """See `Backend.move_towards`; three kernels for all tensors."""
        steps = torch._foreach_sub(list(fast), list(slow))
        torch._foreach_mul_(steps, rate)
        torch._foreach_add_(list(slow), steps)


@functools.cache
def _count_fused_steps() -> None:
    """Makes later steps of fused optimizers count as writes, which torch does not do itself."""

    def count(optimizer: torch.optim.Optimizer, *_: Any) -> None:
        for group in optimizer.param_groups:
            if group.get("fused"):
                torch.autograd.graph.increment_version(group["params"])

    register_optimizer_step_post_hook(count)


def _rssm(model: WorldModel) -> Rssm:
    return cast(Rssm, model.dynamics)  # by `can_compute`


def _gaussian_actor(model: WorldModel) -> Actor:
    return cast(Actor, model.actor)  # a learner calls `Backend.sample` for any other


def _convert_for_rollouts(model: WorldModel, dtype: torch.dtype) -> rollouts.Weights:
    return rollouts.convert_weights(_rssm(model), model.reward_head, model.value_head, model.actor, dtype)


def _convert_for_frames(model: WorldModel, dtype: torch.dtype) -> FrameFunctions:
    if model.has_choices or model.spaces.vector_dim or not model.spaces.has_usual_frames:
        return FrameFunctions(model)
    return NativeFrameFunctions(model) if NativeFrameFunctions.can_pack(model) else TorchFrameFunctions(model)
