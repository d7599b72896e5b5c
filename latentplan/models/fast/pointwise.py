"""Elementwise parts of a GRU step and their gradients; on a GPU each is compiled into one or two kernels.

The functions take plain tensors and run without autograd. A function `name_back` computes the gradients of `name`.
"""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from latentplan.models.dynamics import UPDATE_SHIFT, gaussian, next_deter
from latentplan.models.heads import action_distribution, sample_action

NORM_EPS = 1e-5
MOST_SHAPES = 64  # torch compiles a function for this many shapes, then runs it uncompiled


def run(function: Callable[..., Any], *arguments: Any) -> Any:
    """The result of a function of tensors, compiled if the tensors are on a GPU for which torch can compile."""
    return (_compiled(function) if arguments[0].is_cuda else function)(*arguments)


@functools.cache
def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    return torch.compile(function, dynamic=False) if can_compile("cuda") else function


@functools.cache
def can_compile(device: str) -> bool:
    """Whether torch can compile for a device, which takes a C compiler and a GPU that Triton supports.

    The first call for a device compiles a small function, and warns if that fails.
    """
    import torch._dynamo

    torch._dynamo.config.recompile_limit = max(torch._dynamo.config.recompile_limit, MOST_SHAPES)
    try:
        torch.compile(lambda values: values + 1.0, dynamic=False)(torch.zeros(2, device=device))
    except Exception as error:  # each part of the compiler raises types of its own
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        warnings.warn(f"torch cannot compile here, so updates take longer: {reason}", RuntimeWarning, stacklevel=2)
        return False
    return True


def norm_silu(product: Tensor, scale: Tensor, shift: Tensor) -> Tensor:
    """The SiLU of the layer norm of rows (rows, size)."""
    return functional.silu(functional.layer_norm(product, product.shape[-1:], scale, shift, NORM_EPS))


def norm_silu_with_deter(product: Tensor, scale: Tensor, shift: Tensor, deter: Tensor) -> Tensor:
    """`norm_silu` of the product, concatenated with deter, (rows, size + deter)."""
    return torch.cat([norm_silu(product, scale, shift), deter], -1)


def norm_silu_back(gradient: Tensor, product: Tensor, scale: Tensor, shift: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of the product and of the scaled norm, given the gradient (rows, size or more) of the result."""
    centred, rstd = _centred(product)
    normed = centred * rstd
    scaled = normed * scale + shift
    gate = torch.sigmoid(scaled)
    of_scaled = gradient[:, : product.shape[-1]] * gate * (1.0 + scaled * (1.0 - gate))
    return _norm_input_back(of_scaled * scale, normed, rstd), of_scaled


def update_deter(product: Tensor, scale: Tensor, shift: Tensor, deter: Tensor) -> Tensor:
    """The next deter (rows, deter) from reset, candidate and update gates (rows, 3 deter), as in `Rssm.advance`."""
    normed = functional.layer_norm(product, product.shape[-1:], scale, shift, NORM_EPS)
    return next_deter(normed, deter)


def update_deter_back(
    by_latent: Tensor,
    by_others: Tensor | None,
    directly: Tensor | None,
    gate_inputs: Tensor | None,
    decay: float,
    product: Tensor,
    scale: Tensor,
    shift: Tensor,
    deter: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of the product, of the scaled norm, and of the previous deter without its share through the product.

    Args:
        by_latent: Gradient of the next deter through the latent of the same step.
        by_others: Gradient of the next deter through other readers, such as losses.
        directly: Gradient of the next deter through the following step, without the part through its product.
        gate_inputs: Gradient of the inputs of the following step's product, whose last columns belong to deter.
        decay: Share of `directly` and `gate_inputs` that passes.
        product: Product of the gates, as `update_deter` takes it.
        scale: Scale of the norm.
        shift: Shift of the norm.
        deter: The previous deter.
    """
    gradient = by_latent if by_others is None else by_latent + by_others
    if directly is not None and gate_inputs is not None:
        gradient = gradient + decay * (directly + gate_inputs[:, -deter.shape[-1] :])
    centred, rstd = _centred(product)
    normed = centred * rstd
    reset, candidate, update = (normed * scale + shift).chunk(3, -1)
    reset_gate, update_gate = torch.sigmoid(reset), torch.sigmoid(update - UPDATE_SHIFT)
    candidate_value = torch.tanh(reset_gate * candidate)
    inner = gradient * update_gate * (1.0 - candidate_value * candidate_value)
    of_reset = inner * candidate * reset_gate * (1.0 - reset_gate)
    of_update = gradient * (candidate_value - deter) * update_gate * (1.0 - update_gate)
    of_scaled = torch.cat([of_reset, inner * reset_gate, of_update], -1)
    return _norm_input_back(of_scaled * scale, normed, rstd), of_scaled, gradient * (1.0 - update_gate)


def sample_latent(
    raw: Tensor, noise: Tensor | None, action: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    """A sample of the latent (its mean without noise), mean, std, and the latent concatenated with the next action."""
    mean, std = gaussian(raw)
    stoch = mean if noise is None else mean + std * noise
    return stoch, mean, std, None if action is None else torch.cat([stoch, action], -1)


def sample_latent_back(
    raw: Tensor,
    noise: Tensor | None,
    stoch: Tensor | None,
    mean: Tensor | None,
    std: Tensor | None,
    inputs: Tensor | None,
    decay: float,
) -> Tensor:
    """Gradient of `raw`, given the gradients of stoch, mean and std.

    The first columns of `inputs` are the gradient of stoch through the following step; the share `decay` of it passes.
    """
    latent = raw.shape[-1] // 2
    gate = torch.sigmoid(raw[:, latent:] / 2.0)
    of_stoch = torch.zeros_like(gate) if stoch is None else stoch
    if inputs is not None:
        of_stoch = of_stoch + decay * inputs[:, :latent]
    of_mean = of_stoch if mean is None else of_stoch + mean
    of_std = torch.zeros_like(gate) if noise is None else of_stoch * noise
    of_std = of_std if std is None else of_std + std
    return torch.cat([of_mean, of_std * gate * (1.0 - gate)], -1)


def sample_features(raw: Tensor, noise: Tensor, deter: Tensor) -> tuple[Tensor, Tensor]:
    """A sample of the latent, (rows, latent), and the features (rows, deter + latent)."""
    mean, std = gaussian(raw)
    stoch = mean + std * noise
    return stoch, torch.cat([deter, stoch], -1)


def append_action(raw: Tensor, noise: Tensor, stoch: Tensor) -> Tensor:
    """The latent concatenated with an action sample, for the output of the actor's last layer (rows, 2 action)."""
    return torch.cat([stoch, sample_action(*action_distribution(raw), noise)], -1)


def norm_back(of_scaled: Tensor, product: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of a layer norm's scale and shift, (size,) each, over rows (rows, size)."""
    centred, rstd = _centred(product)
    return (of_scaled * centred * rstd).sum(0), of_scaled.sum(0)


def _centred(product: Tensor) -> tuple[Tensor, Tensor]:
    centred = product - product.mean(-1, keepdim=True)
    return centred, torch.rsqrt(centred.square().mean(-1, keepdim=True) + NORM_EPS)


def _norm_input_back(of_normed: Tensor, normed: Tensor, rstd: Tensor) -> Tensor:
    along = (of_normed * normed).mean(-1, keepdim=True)
    return rstd * (of_normed - of_normed.mean(-1, keepdim=True) - normed * along)
