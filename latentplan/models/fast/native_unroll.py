"""The RSSM over whole sequences in one compiled call each way, for processors.

Autograd runs some thousand small operations for a recurrence, each of which costs more than its arithmetic. `unroll.c`
computes all steps of a block of rows before the next block, and writes the factors of the weights' gradients, which are
one product over all steps.
"""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from latentplan.models.dynamics import Gaussian, State
from latentplan.models.fast import native_heads
from latentplan.models.fast.native import (
    CPU,
    Count,
    Layer,
    Place,
    allocate,
    borrow,
    check_called,
    check_shape,
    describe_layer,
    give_back,
    lay_rows,
    pad_rows,
    pad_size,
    point_to,
    require_kernels,
    split_norms,
    take_kept,
    weight_gradient,
)
from latentplan.models.fast.unroll import Weights, collect_weights
from latentplan.models.heads import action_distribution, sample_action

if TYPE_CHECKING:
    from latentplan.models.dynamics import Rssm
    from latentplan.models.heads import Actor

_GIVEN = ("start_deter", "start_stoch", "embeddings", "noise", "action_noise", "actions")
_STATES = ("deters", "stochs")
_RESULTS = ("deters", "stochs", "means", "stds")
_SUMS = ("first", "gate_products", "second", "raw")
_INPUTS = ("inputs", "gate_inputs", "afters", "hiddens")


class _Unroll(ctypes.Structure):
    _fields_ = (
        *((name, Layer) for name in ("input", "gates", "hidden", "output")),
        ("actor", Layer * 3),
        *(
            (name, Count)
            for name in ("rows", "steps", "action", "latent", "deter", "has_frames", "keeps_inputs", "has_actor")
        ),
        ("decay", ctypes.c_double),
        *((name, Place) for name in _GIVEN),
        ("state_stride", Count * 2),
        *((name, Place) for name in (*_RESULTS, *_SUMS, *_INPUTS)),
    )


class _Gradients(ctypes.Structure):
    _fields_ = (
        ("state_stride", Count * 2),
        *((name, Place) for name in ("of_deters", "of_stochs", "of_means", "of_stds")),
        *((name, Place) for name in ("of_first", "of_gates", "of_second", "of_raw")),
        *((name, Place) for name in ("of_actions", "of_embeddings", "norms")),
    )


def observe(
    dynamics: Rssm, embeddings: Tensor, actions: Tensor, deter: Tensor, noise: Tensor
) -> tuple[State, Gaussian]:
    """The same as `Rssm.observe`; gradients reach the weights and the embeddings."""
    given = (_by_time(embeddings), _by_time(actions), deter, None, _by_time(noise))
    results = _Unrolled.apply(*given, *collect_weights(dynamics, prior=False))
    deters, stochs, means, stds = (part.transpose(0, 1) for part in results)
    return State(deters, stochs), Gaussian(means, stds)


def predict(dynamics: Rssm, start: State, actions: Tensor) -> tuple[Tensor, Gaussian]:
    """The same as `Rssm.predict`; gradients reach the weights alone."""
    weights = collect_weights(dynamics, prior=True)
    results = _Unrolled.apply(None, _by_time(actions), start.deter, start.stoch, None, *weights)
    deters, _, means, stds = (part.transpose(0, 1) for part in results)
    return deters, Gaussian(means, stds)


def imagine(
    dynamics: Rssm, actor: Actor, start: State, action_noise: Tensor, noise: Tensor, decay: float
) -> tuple[Tensor, Tensor]:
    """The same as `unroll.imagine`, for which see the arguments."""
    weights = collect_weights(dynamics, prior=True)
    with torch.no_grad():
        call = _Call(weights, start.deter, start.stoch, None, None, noise, (actor, action_noise), decay)
        features = call.features[:, : len(start.deter)]
    # The actor runs once more on all states at once, because its gradient needs no recurrence.
    mean, std = action_distribution(native_heads.apply(actor.mlp, features[:-1]))
    return _Imagined.apply(sample_action(mean, std, action_noise), features, call), std


class _Call:
    """One run through all steps, with what its gradients need.

    Args:
        weights: Parameters of the recurrence.
        deter: Deterministic state before the first step, (rows, deter).
        stoch: Latent before the first step, (rows, latent); None if the first step has a frame and no action.
        embeddings: Embeddings of frames, (step, rows, embedding); None without frames.
        actions: Actions, (step, rows, action); None if the actor chooses them.
        noise: Standard normal draws of the latents, (step, rows, latent); None for their mean.
        policy: The actor and its standard normal draws, (step, rows, action).
        decay: Share of a state's gradient that a step passes back to the step before.
    """

    def __init__(
        self,
        weights: Weights,
        deter: Tensor,
        stoch: Tensor | None,
        embeddings: Tensor | None,
        actions: Tensor | None,
        noise: Tensor | None,
        policy: tuple[Actor, Tensor] | None = None,
        decay: float = 1.0,
    ) -> None:
        self.kernels = kernels = require_kernels(weights.gates)
        self.weights, self.rows = weights, len(deter)
        self.learns = policy is None  # in imagined rollouts the weights get no gradient
        has_frames, draws = embeddings is not None, None if policy is None else policy[1]
        example = actions if actions is not None else draws
        assert example is not None
        self._check_shapes(deter, stoch, embeddings, noise, example, len(example) + has_frames)
        self.given = {
            name: None if part is None else pad_rows(part.to(kernels.real), part.dim() - 2)
            for name, part in zip(_GIVEN, (deter, stoch, embeddings, noise, draws, actions), strict=True)
        }
        rows, steps = len(self.given["start_deter"]), len(example) + has_frames  # type: ignore[arg-type]
        if actions is None:
            self.given["actions"] = allocate(steps, rows, example.shape[-1], dtype=kernels.real)
        self.results = self._allocate(steps, rows)
        self.kept: dict[str, Tensor | None] | None = {name: self.results[name] for name in (*_SUMS, *_INPUTS)}
        self.structure = self._describe(steps, rows, example.shape[-1], policy, decay)
        failed = kernels.library.unroll(ctypes.addressof(self.structure), torch.get_num_threads())
        check_called(failed)

    def _check_shapes(
        self,
        deter: Tensor,
        stoch: Tensor | None,
        embeddings: Tensor | None,
        noise: Tensor | None,
        example: Tensor,
        steps: int,
    ) -> None:
        weights, rows = self.weights, self.rows
        latent = len(weights.output) // 2
        check_shape("deter", deter, rows, len(weights.gates) // 3)
        check_shape("stoch", stoch, rows, latent)
        check_shape("embeddings", embeddings, steps, rows, len(weights.hidden))
        check_shape("noise", noise, steps, rows, latent)
        check_shape("actions", example, len(example), rows, weights.input.shape[1] - latent)

    def _allocate(self, steps: int, rows: int) -> dict[str, Tensor]:
        weights, kernels, has_frames = self.weights, self.kernels, self.given["embeddings"] is not None
        deter, latent = weights.gates.shape[0] // 3, weights.output.shape[0] // 2
        first, gates, second = len(weights.input), len(weights.gates), len(weights.hidden)
        sizes = (first, gates, second, 2 * latent, weights.input.shape[1], weights.gates.shape[1], deter, second)
        results = {
            name: allocate(steps, rows, size, dtype=kernels.real)
            for name, size in zip(_RESULTS, (deter, latent, latent, latent), strict=True)
        }
        if not self.learns:  # imagined states lie side by side, as the features that heads read
            self.features = allocate(steps + 1, rows, deter + latent, dtype=kernels.real)
            torch.cat([self.given["start_deter"], self.given["start_stoch"]], -1, out=self.features[0])  # type: ignore[list-item]
            results["deters"], results["stochs"] = self.features[1:].split([deter, latent], -1)
        for name, size in zip((*_SUMS, *_INPUTS), sizes, strict=True):
            count = steps - (has_frames and name in ("inputs", "gate_inputs", "first", "gate_products"))
            kept = count if name in _SUMS or self.learns else 1
            results[name] = borrow(kept, rows, pad_size(size), dtype=kernels.half)
        return results

    def _describe(
        self, steps: int, rows: int, action: int, policy: tuple[Actor, Tensor] | None, decay: float
    ) -> _Unroll:
        weights = self.weights
        structure = _Unroll(
            describe_layer(weights.input, weights.input_scale, weights.input_shift),
            describe_layer(weights.gates, weights.gates_scale, weights.gates_shift),
            describe_layer(weights.hidden, weights.hidden_scale, weights.hidden_shift),
            describe_layer(weights.output, None, weights.output_bias),
        )
        if policy is not None:
            structure.actor = (Layer * 3)(
                *native_heads.describe_network(native_heads.collect_parameters(policy[0].mlp))
            )
        structure.rows, structure.steps, structure.action, structure.decay = rows, steps, action, decay
        structure.latent, structure.deter = len(weights.output) // 2, len(weights.gates) // 3
        structure.keeps_inputs = self.learns
        structure.has_frames, structure.has_actor = self.given["embeddings"] is not None, policy is not None
        states = [self.results[name] for name in _STATES]
        structure.state_stride = (Count * 2)(*(part.stride(1) for part in states))
        structure.deters, structure.stochs = (part.data_ptr() for part in states)
        others = {name: part for name, part in self.results.items() if name not in _STATES}
        point_to(structure, **self.given, **others)
        return structure

    def backward(self, outer: tuple[Tensor | None, ...]) -> tuple[Tensor | None, Tensor | None, tuple[Tensor, ...]]:
        """Gradients of embeddings, actions and weights, given those of deters, stochs, means and stds."""
        weights, results, kernels = self.weights, self.results, self.kernels
        kept = take_kept(self)
        laid = [None if part is None else lay_rows(part, kernels.real) for part in outer]
        factors = {
            f"of_{name}": borrow(*(part.shape if self.learns else (1, *part.shape[1:])), dtype=kernels.half)
            for name, part in zip(("first", "gates", "second", "raw"), map(results.__getitem__, _SUMS), strict=True)
        }
        sizes = [len(weights.input), len(weights.gates), len(weights.hidden)]
        norms = torch.zeros(2 * sum(sizes), dtype=kernels.real, device=CPU)
        embeddings, actions = self.given["embeddings"], self.given["actions"]
        of_embeddings = None if embeddings is None else torch.empty_like(embeddings)
        of_actions = None if self.learns or actions is None else torch.empty_like(actions)
        gradients = _Gradients()
        gradients.state_stride = (Count * 2)(*(0 if part is None else part.stride(1) for part in laid[:2]))
        gradients.of_deters, gradients.of_stochs = (None if part is None else part.data_ptr() for part in laid[:2])
        point_to(
            gradients,
            of_means=laid[2],
            of_stds=laid[3],
            **factors,
            of_actions=of_actions,
            of_embeddings=of_embeddings,
            norms=norms,
        )
        addresses = ctypes.addressof(self.structure), ctypes.addressof(gradients)
        check_called(kernels.library.unroll_back(*addresses, torch.get_num_threads()))
        of_embeddings, of_actions = (
            None if part is None else part[:, : self.rows] for part in (of_embeddings, of_actions)
        )
        of_weights = self._collect(factors, norms, sizes) if self.learns else ()
        give_back([*kept.values(), *factors.values()])
        return of_embeddings, of_actions, of_weights

    def _collect(self, factors: dict[str, Tensor], norms: Tensor, sizes: list[int]) -> tuple[Tensor, ...]:
        """Gradients of all parameters, in the order of `Weights`."""
        weights, results = self.weights, self.results
        norm = split_norms(norms, sizes)
        of_raw = factors["of_raw"]
        bias = of_raw.flatten(0, 1).sum(0, dtype=norms.dtype)[: len(weights.output_bias)]
        return (
            *(weight_gradient(factors["of_first"], results["inputs"], weights.input), *norm[:2]),
            *(weight_gradient(factors["of_gates"], results["gate_inputs"], weights.gates), *norm[2:4]),
            *(weight_gradient(factors["of_second"], results["afters"], weights.hidden), *norm[4:]),
            *(weight_gradient(of_raw, results["hiddens"], weights.output), bias),
        )


class _Unrolled(torch.autograd.Function):
    """deter, stoch, mean and std of each step, (time, rows, ...) each; see `_Call`."""

    @staticmethod
    def forward(
        ctx: Any,
        embeddings: Tensor | None,
        actions: Tensor,
        deter: Tensor,
        stoch: Tensor | None,
        noise: Tensor | None,
        *parameters: Tensor,
    ) -> tuple[Tensor, ...]:
        ctx.call = call = _Call(Weights(*parameters), deter, stoch, embeddings, actions, noise)
        ctx.set_materialize_grads(False)
        return tuple(call.results[name][:, : call.rows] for name in _RESULTS)

    @staticmethod
    def backward(ctx: Any, *outer: Tensor | None) -> tuple[Tensor | None, ...]:
        of_embeddings, _, of_weights = ctx.call.backward(outer)
        return (of_embeddings, None, None, None, None, *of_weights)


class _Imagined(torch.autograd.Function):
    """Imagined features (horizon + 1, rows, feature) as a function of the actions (horizon, rows, action)."""

    @staticmethod
    def forward(ctx: Any, actions: Tensor, features: Tensor, call: _Call) -> Tensor:
        ctx.call = call
        return features.view_as(features)

    @staticmethod
    def backward(ctx: Any, outer: Tensor) -> tuple[Tensor | None, ...]:
        call: _Call = ctx.call
        deter = len(call.weights.gates) // 3
        parts = (outer[1:, :, :deter], outer[1:, :, deter:], None, None)
        return call.backward(parts)[1], None, None


def _by_time(tensor: Tensor) -> Tensor:
    return tensor.transpose(0, 1)
