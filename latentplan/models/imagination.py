"""Following many action sequences by the mean of the prior: the planner's hot path.

Equals `WorldModel.step` taken again and again, with the same arithmetic arranged for speed: weights are turned and cast
once, the actions' share of the input is computed for all steps at once, the prior's std is left out, rows go through
in blocks that stay in the cache, and the gates meet in float32, where the elementwise functions are fastest. Nothing is
written in place, so that plans can be refined by gradients.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from latentplan.models.dynamics import Rssm, State
from latentplan.models.heads import NormedLinear, ScalarHead

ROWS_PER_THREAD = 1024  # what one step makes of more rows no longer fits a core's cache
BIN_MULTIPLE = 16  # float32 products with another number of columns take half as long again

Norm = tuple[Tensor, Tensor]  # scale and shift


class Weights(NamedTuple):
    """Recurrence and reward head, laid out for products from the left: (in, out).

    Into the gates' norm go the 1 that the update gate subtracts, and the factor 2 of tanh(x) = 2 sigmoid(2 x) - 1.
    """

    action: Tensor
    stoch: Tensor
    input_norm: Norm
    gates: Tensor
    gates_norm: Norm
    prior: Tensor
    prior_norm: Norm
    mean: Tensor
    mean_shift: Tensor
    head: tuple[tuple[Tensor, Norm], ...]
    logits: Tensor
    logits_shift: Tensor
    values: Tensor


@torch.no_grad()
def lay_out(dynamics: Rssm, head: ScalarHead, dtype: torch.dtype) -> Weights:
    """The weights of a recurrence and a reward head, products in `dtype`; gates' norm and head's output in float32."""

    def turn(weight: Tensor) -> Tensor:
        return weight.to(dtype).t().contiguous()

    def norm(layer: nn.LayerNorm) -> Norm:
        return layer.weight.to(dtype), layer.bias.to(dtype)

    latent, deter = dynamics.latent_dim, dynamics.deter_dim
    input_weight, output = dynamics.input.linear.weight, head.mlp.output
    scale, shift = (part.float().clone() for part in (dynamics.gates_norm.weight, dynamics.gates_norm.bias))
    scale[deter : 2 * deter] *= 2.0
    shift[deter : 2 * deter] *= 2.0
    shift[2 * deter :] -= 1.0
    hidden_layers = [layer for layer in head.mlp.trunk if isinstance(layer, NormedLinear)]
    padding = -output.out_features % BIN_MULTIPLE
    return Weights(
        action=turn(input_weight[:, latent:]),
        stoch=turn(input_weight[:, :latent]),
        input_norm=norm(dynamics.input.norm),
        gates=turn(dynamics.gates.weight),
        gates_norm=(scale, shift),
        prior=turn(dynamics.prior_hidden.linear.weight),
        prior_norm=norm(dynamics.prior_hidden.norm),
        mean=turn(dynamics.prior_output.weight[:latent]),
        mean_shift=dynamics.prior_output.bias[:latent].to(dtype),
        head=tuple((turn(layer.linear.weight), norm(layer.norm)) for layer in hidden_layers),
        logits=functional.pad(output.weight.t(), (0, padding)),
        logits_shift=functional.pad(output.bias, (0, padding), value=float("-inf")),
        values=functional.pad(head.values, (0, padding)),
    )


def imagine(weights: Weights, state: State, actions: Tensor) -> tuple[Tensor, State]:
    """Rewards float32 (rows, time) along sequences, and the last state, float32.

    Args:
        weights: What `lay_out` gave.
        state: Where every sequence starts, (rows, ...).
        actions: In [-1, 1], (rows, time, action).
    """
    block = ROWS_PER_THREAD * torch.get_num_threads() if actions.device.type == "cpu" else len(actions)
    with torch.autocast(actions.device.type, enabled=False):
        blocks = zip(*(part.split(block) for part in (*state, actions)), strict=True)
        parts = [_imagine_block(weights, *rows) for rows in blocks]
    rewards, deters, stochs = (torch.cat(part) for part in zip(*parts, strict=True))
    return rewards, State(deters, stochs)


def _imagine_block(weights: Weights, deter: Tensor, stoch: Tensor, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    dtype = weights.gates.dtype
    # Few rows take the reward head many steps at a time: one product of a thousand rows costs two of a hundred.
    steps_at_once = max(1, ROWS_PER_THREAD * torch.get_num_threads() // len(actions))
    pushes = actions.transpose(0, 1).to(dtype).contiguous() @ weights.action  # (time, rows, hidden)
    deter, rounded, stoch = deter.float(), deter.to(dtype), stoch.to(dtype)
    seen, rewards = [], []
    for push in pushes:
        deter = _advance(weights, deter, rounded, stoch, push)
        rounded = deter.to(dtype)
        stoch = torch.addmm(weights.mean_shift, _layer(rounded, weights.prior, weights.prior_norm), weights.mean)
        seen.append(torch.cat([rounded, stoch], -1))
        if len(seen) == steps_at_once:
            rewards.append(_rewards(weights, seen))
            seen = []
    if seen:
        rewards.append(_rewards(weights, seen))
    return torch.cat(rewards, 1), deter, stoch.float()


def _advance(weights: Weights, deter: Tensor, rounded: Tensor, stoch: Tensor, push: Tensor) -> Tensor:
    """The next deter (rows, deter), float32; `push` (rows, hidden) is the action's share of the input."""
    hidden = _normed(torch.addmm(push, stoch, weights.stoch), weights.input_norm)
    product = torch.cat([hidden, rounded], -1) @ weights.gates
    gates = functional.layer_norm(product.float(), product.shape[-1:], *weights.gates_norm)
    reset, candidate, update = gates.chunk(3, -1)
    candidate = 2.0 * torch.sigmoid(torch.sigmoid(reset) * candidate) - 1.0
    return torch.lerp(deter, candidate, torch.sigmoid(update))


def _rewards(weights: Weights, seen: list[Tensor]) -> Tensor:
    """The reward at each of the features (rows, feature) seen: (rows, len(seen))."""
    features = torch.cat(seen)
    for weight, norm in weights.head:
        features = _layer(features, weight, norm)
    logits = torch.addmm(weights.logits_shift, features.float(), weights.logits)
    return (logits.softmax(-1) @ weights.values).unflatten(0, (len(seen), -1)).t()


def _layer(features: Tensor, weight: Tensor, norm: Norm) -> Tensor:
    return _normed(features @ weight, norm)


def _normed(product: Tensor, norm: Norm) -> Tensor:
    return functional.silu(functional.layer_norm(product, product.shape[-1:], *norm))
