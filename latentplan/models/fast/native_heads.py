"""Heads in one compiled call each way, for processors: networks, means of bins, cross-entropies and λ-returns."""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor

from latentplan.models.fast.native import (
    CPU,
    Count,
    Layer,
    Place,
    allocate,
    borrow,
    check_called,
    check_place,
    check_shape,
    describe_layer,
    give_back,
    pad_rows,
    pad_size,
    point_to,
    require_kernels,
    split_norms,
    take_kept,
    weight_gradient,
)
from latentplan.models.heads import Mlp, NormedLinear, ScalarHead

_SUMS = ("products", "last_products")
_INPUTS = ("inputs", "hidden", "last")
_FACTORS = ("of_output", "of_second", "of_first")


class _Network(ctypes.Structure):
    _fields_ = (
        *((name, Layer) for name in ("first", "second", "output")),
        ("rows", Count),
        *((name, Place) for name in ("features", "results", *_SUMS, *_INPUTS)),
    )


class _Gradients(ctypes.Structure):
    _fields_ = tuple((name, Place) for name in ("of_results", *_FACTORS, "of_features", "norms"))


def apply(mlp: Mlp, features: Tensor) -> Tensor:
    """The outputs of a network, (..., out), for features (..., in); gradients reach the features and the weights."""
    parameters = collect_parameters(mlp)
    check_shape("features", features, *features.shape[:-1], parameters[0].shape[1])
    results: Tensor = _Applied.apply(features, *parameters)
    return results


def mean(head: ScalarHead, logits: Tensor) -> Tensor:
    """See `ScalarHead.mean`."""
    check_shape("logits", logits, *logits.shape[:-1], len(head.values))
    means: Tensor = _Mean.apply(logits, head.values)
    return means


def cross_entropy(head: ScalarHead, logits: Tensor, targets: Tensor) -> Tensor:
    """See `ScalarHead.loss`."""
    check_shape("logits", logits, *targets.shape, len(head.values))
    check_place("targets", targets)
    losses: Tensor = _CrossEntropy.apply(logits, head.values, targets.detach().to(logits.dtype))
    return losses


def lambda_return(rewards: Tensor, discounts: Tensor, values: Tensor, lambda_: float) -> Tensor:
    """See `Backend.lambda_return`."""
    check_place("rewards", rewards)
    check_shape("discounts", discounts, *rewards.shape)
    check_shape("values", values, *rewards.shape)
    returns: Tensor = _LambdaReturn.apply(rewards, discounts.to(rewards.dtype), values.to(rewards.dtype), lambda_)
    return returns


def collect_parameters(mlp: Mlp) -> tuple[Tensor, ...]:
    """Weight, scale and shift of both hidden layers, then weight and bias of the output."""
    layers = [layer for layer in mlp.trunk if isinstance(layer, NormedLinear)]
    hidden = [(layer.linear.weight, layer.norm.weight, layer.norm.bias) for layer in layers]
    return *hidden[0], *hidden[1], mlp.output.weight, mlp.output.bias


def describe_network(parameters: tuple[Tensor, ...]) -> tuple[Layer, Layer, Layer]:
    """The layers with the parameters of `collect_parameters`."""
    first, second, output = parameters[:3], parameters[3:6], parameters[6:]
    return describe_layer(*first), describe_layer(*second), describe_layer(output[0], None, output[1])


class _Applied(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, features: Tensor, *parameters: Tensor) -> Tensor:
        kernels, layers = require_kernels(parameters[0]), describe_network(parameters)
        flat = pad_rows(features.to(kernels.real).reshape(-1, features.shape[-1]), 0)
        sizes = [pad_size(size) for size in (layers[0].inputs, layers[0].outputs, layers[1].outputs)]
        learns = any(ctx.needs_input_grad[1:])
        kept = {
            name: borrow(len(flat), size, dtype=kernels.half) if learns or name in _SUMS else None
            for name, size in zip((*_SUMS, *_INPUTS), (*sizes[1:], *sizes), strict=True)
        }
        results = allocate(len(flat), layers[2].outputs, dtype=kernels.real)
        ctx.network = network = _Network(*layers, len(flat))
        point_to(network, features=flat, results=results, **kept)
        failed = kernels.library.apply_network(ctypes.addressof(network), torch.get_num_threads())
        check_called(failed)
        ctx.kernels, ctx.kept, ctx.parameters, ctx.shape = kernels, kept, parameters, features.shape
        return results[: features.shape[:-1].numel()].unflatten(0, features.shape[:-1])

    @staticmethod
    def backward(ctx: Any, outer: Tensor) -> tuple[Tensor | None, ...]:
        network, kernels, kept, parameters = ctx.network, ctx.kernels, take_kept(ctx), ctx.parameters
        outer = pad_rows(outer.reshape(-1, outer.shape[-1]), 0)
        learns = kept["inputs"] is not None
        sizes = [pad_size(layer.outputs) for layer in (network.output, network.second, network.first)]
        factors: dict[str, Any] = {
            name: borrow(len(outer), size, dtype=kernels.half) if learns else None
            for name, size in zip(_FACTORS, sizes, strict=True)
        }
        widths = [network.first.outputs, network.second.outputs]
        norms = torch.zeros(2 * sum(widths), dtype=kernels.real, device=CPU)
        of_features = allocate(len(outer), ctx.shape[-1], dtype=kernels.real) if ctx.needs_input_grad[0] else None
        gradients = _Gradients()
        point_to(gradients, of_results=outer, of_features=of_features, norms=norms, **factors)
        addresses = ctypes.addressof(network), ctypes.addressof(gradients)
        check_called(kernels.library.apply_network_back(*addresses, torch.get_num_threads()))
        if of_features is not None:
            of_features = of_features[: ctx.shape[:-1].numel()].view(ctx.shape)
        if not learns:
            give_back(kept.values())
            return of_features, *([None] * len(parameters))
        norm = split_norms(norms, widths)
        of_parameters = (
            *(weight_gradient(factors["of_first"], kept["inputs"], parameters[0]), *norm[:2]),
            *(weight_gradient(factors["of_second"], kept["hidden"], parameters[3]), *norm[2:]),
            *(weight_gradient(factors["of_output"], kept["last"], parameters[6]), outer.sum(0)),
        )
        give_back([*kept.values(), *factors.values()])
        return of_features, *of_parameters


class _Mean(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, logits: Tensor, values: Tensor) -> Tensor:
        logits, values = logits.contiguous(), values.to(logits.dtype)
        means = logits.new_empty(logits.shape[:-1])
        of_logits = torch.empty_like(logits) if ctx.needs_input_grad[0] else None
        places = [None if part is None else part.data_ptr() for part in (logits, values, means, of_logits)]
        require_kernels(logits).library.mean_of_bins(*places, means.numel(), logits.shape[-1])
        ctx.of_logits = of_logits
        return means

    @staticmethod
    def backward(ctx: Any, outer: Tensor) -> tuple[Tensor, None]:
        return ctx.of_logits * outer.unsqueeze(-1), None


class _CrossEntropy(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, logits: Tensor, values: Tensor, targets: Tensor) -> Tensor:
        logits, targets, values = logits.contiguous(), targets.contiguous(), values.to(logits.dtype)
        losses, ctx.of_logits = torch.empty_like(targets), torch.empty_like(logits)
        places = [part.data_ptr() for part in (logits, values, targets, losses, ctx.of_logits)]
        require_kernels(logits).library.cross_entropy(*places, losses.numel(), logits.shape[-1])
        return losses

    @staticmethod
    def backward(ctx: Any, outer: Tensor) -> tuple[Tensor, None, None]:
        return ctx.of_logits * outer.unsqueeze(-1), None, None


class _LambdaReturn(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rewards: Tensor, discounts: Tensor, values: Tensor, lambda_: float) -> Tensor:
        rewards, discounts, values = (part.contiguous() for part in (rewards, discounts, values))
        returns = torch.empty_like(rewards)
        places = [part.data_ptr() for part in (rewards, discounts, values)]
        steps, rows = len(rewards), rewards[0].numel()
        require_kernels(rewards).library.lambda_return(*places, lambda_, returns.data_ptr(), steps, rows)
        ctx.save_for_backward(discounts, values, returns)  # an output in an attribute would be a reference cycle
        ctx.lambda_ = lambda_
        return returns

    @staticmethod
    def backward(ctx: Any, outer: Tensor) -> tuple[Tensor, Tensor, Tensor, None]:
        outer, gradients = outer.contiguous(), [torch.empty_like(outer) for _ in range(3)]
        before = [part.data_ptr() for part in ctx.saved_tensors]
        after = [part.data_ptr() for part in (outer, *gradients)]
        require_kernels(outer).library.lambda_return_back(*before, ctx.lambda_, *after, len(outer), outer[0].numel())
        return gradients[0], gradients[1], gradients[2], None
