"""Rollouts of many action sequences along the mean of the prior, with weights that are converted once.

The result equals repeated calls of `Backend.step` up to rounding. Weights are transposed and cast once, the prior's std
is not computed, and rows are processed in blocks that fit the cache. A rollout is one compiled call (`compiled`); where
sizes or precision do not allow it, torch computes, with compiled kernels for the elementwise parts (`library`). If
gradients are required, no tensor is changed in place.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from latentplan.models.dynamics import Rssm, State
from latentplan.models.fast import compiled
from latentplan.models.fast.library import Norm, expectation, gates, norm_silu
from latentplan.models.heads import Actor, MixedActor, Mlp, NormedLinear, ScalarHead, action_distribution

ROWS_PER_THREAD = 1024  # results of one step for more rows do not fit a core's cache
BIN_MULTIPLE = 16  # float32 products with other numbers of columns take 1.5 times as long

Trunk = tuple[tuple[Tensor, Norm], ...]  # weight and norm of each hidden layer of an Mlp


class Weights(NamedTuple):
    """Weights of dynamics, reward head and actor, transposed to (in, out).

    Attributes:
        action: Columns of the GRU's input layer for the action.
        stoch: Columns of the GRU's input layer for the latent.
        input_norm: Norm of the GRU's input layer.
        gates: Gates of the GRU.
        gates_norm: Norm of the gates.
        prior: Hidden layer of the prior.
        prior_norm: Norm of the prior's hidden layer.
        mean: From the prior's hidden layer to the mean of the latent.
        mean_shift: Shift of the latent's mean.
        head: Hidden layers of the reward head.
        logits: From the reward head's hidden layers to the logits of the bins, float32.
        logits_shift: Shift of the logits; minus infinity for padded bins.
        values: Value of each bin.
        actor: Hidden layers of the actor.
        actor_output: From the actor's hidden layers to mean and raw std of the action, float32.
        actor_shift: Shift of the actor's output.
        packed: All weights and the value head's in the layout of compiled calls; None if torch has to compute.
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
    head: Trunk
    logits: Tensor
    logits_shift: Tensor
    values: Tensor
    actor: Trunk
    actor_output: Tensor
    actor_shift: Tensor
    packed: compiled.Packed | None = None


@torch.no_grad()
def convert_weights(
    dynamics: Rssm, head: ScalarHead, critic: ScalarHead, actor: Actor | MixedActor, dtype: torch.dtype
) -> Weights:
    """Converted weights for products in `dtype`; the norm of the gates and the outputs of heads are float32.

    Args:
        dynamics: The dynamics of the rollouts.
        head: The reward head.
        critic: The value head, with the same bins.
        actor: The actor that proposes sequences.
        dtype: Precision of the products.
    """

    def transpose(weight: Tensor) -> Tensor:
        return weight.to(dtype).t().contiguous()

    def norm(layer: nn.LayerNorm) -> Norm:
        # On devices other than the CPU, product and norm must have the same dtype.
        norm_dtype = torch.float32 if layer.weight.device.type == "cpu" else dtype
        return layer.weight.to(norm_dtype), layer.bias.to(norm_dtype)

    def trunk(mlp: Mlp) -> Trunk:
        layers = [layer for layer in mlp.trunk if isinstance(layer, NormedLinear)]
        return tuple((transpose(layer.linear.weight), norm(layer.norm)) for layer in layers)

    def logits(head: ScalarHead) -> tuple[Tensor, Tensor]:
        output, padding = head.mlp.output, (0, -len(head.values) % BIN_MULTIPLE)
        return functional.pad(output.weight.t(), padding), functional.pad(output.bias, padding, value=float("-inf"))

    latent, input_weight = dynamics.latent_dim, dynamics.input.linear.weight
    reward_logits, reward_shift = logits(head)
    weights = Weights(
        action=transpose(input_weight[:, latent:]),
        stoch=transpose(input_weight[:, :latent]),
        input_norm=norm(dynamics.input.norm),
        gates=transpose(dynamics.gates.weight),
        gates_norm=(dynamics.gates_norm.weight.float(), dynamics.gates_norm.bias.float()),
        prior=transpose(dynamics.prior_hidden.linear.weight),
        prior_norm=norm(dynamics.prior_hidden.norm),
        mean=transpose(dynamics.prior_output.weight[:latent]),
        mean_shift=dynamics.prior_output.bias[:latent].to(dtype),
        head=trunk(head.mlp),
        logits=reward_logits,
        logits_shift=reward_shift,
        values=functional.pad(head.values, (0, -len(head.values) % BIN_MULTIPLE)),
        actor=trunk(actor.mlp),
        actor_output=actor.mlp.output.weight.t().contiguous(),
        actor_shift=actor.mlp.output.bias.clone(),
    )
    return weights._replace(packed=compiled.pack(weights, (trunk(critic.mlp), *logits(critic))))


def imagine(weights: Weights, state: State, actions: Tensor) -> tuple[Tensor, State]:
    """Rewards float32 (rows, time) along sequences, and the last state, float32.

    Args:
        weights: Converted weights from `convert_weights`.
        state: Start of every sequence, (rows, ...).
        actions: Actions in [-1, 1], (rows, time, action).
    """
    if weights.packed is not None and not requires_gradients(*state, actions):
        rewards, *last = compiled.rollout(weights.packed, *state, actions)
        return rewards, State(*last)
    block = ROWS_PER_THREAD * torch.get_num_threads() if actions.device.type == "cpu" else len(actions)
    with torch.autocast(actions.device.type, enabled=False):
        blocks = zip(*(part.split(block) for part in (*state, actions)), strict=True)
        parts = [_imagine_block(weights, *rows) for rows in blocks]
    rewards, deters, stochs = (torch.cat(part) for part in zip(*parts, strict=True))
    return rewards, State(deters, stochs)


def propose(weights: Weights, state: State, noise: Tensor) -> Tensor:
    """Actions of the actor along the mean of the prior, float32 (rows, time, action).

    Args:
        weights: Converted weights from `convert_weights`.
        state: Start of every sequence, (rows, ...).
        noise: Standard normal draws for samples, zeros for the mode, (rows, time, action).
    """
    if weights.packed is not None and not requires_gradients(*state, noise):
        return compiled.propose(weights.packed, *state, noise)
    deter, stoch = state.deter.float(), state.stoch.to(weights.gates.dtype)
    rounded, actions = deter.to(stoch.dtype), []
    with torch.autocast(noise.device.type, enabled=False):
        for draw in noise.unbind(1):
            hidden = torch.cat([rounded, stoch], -1)
            for weight, norm in weights.actor:
                hidden = _apply_layer(hidden, weight, norm)
            mean, std = action_distribution(torch.addmm(weights.actor_shift, hidden.float(), weights.actor_output))
            actions.append(torch.addcmul(mean, std, draw).clamp(-1.0, 1.0))
            by_action = actions[-1].to(stoch.dtype) @ weights.action
            deter, rounded, stoch = _step(weights, deter, rounded, stoch, by_action)
    return torch.stack(actions, 1)


def requires_gradients(*tensors: Tensor) -> bool:
    """Whether autograd would record a computation from these tensors."""
    return torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)


def _imagine_block(weights: Weights, deter: Tensor, stoch: Tensor, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    dtype = weights.gates.dtype
    # For few rows the reward head reads many steps at once: a product of 1000 rows costs as much as two of 100.
    steps_at_once = max(1, ROWS_PER_THREAD * torch.get_num_threads() // len(actions))
    products = actions.transpose(0, 1).to(dtype).contiguous() @ weights.action  # (time, rows, hidden)
    deter, rounded, stoch = deter.float(), deter.to(dtype), stoch.to(dtype)
    features, rewards = [], []
    for by_action in products:
        deter, rounded, stoch = _step(weights, deter, rounded, stoch, by_action)
        features.append(torch.cat([rounded, stoch], -1))
        if len(features) == steps_at_once:
            rewards.append(_predict_rewards(weights, features))
            features = []
    if features:
        rewards.append(_predict_rewards(weights, features))
    return torch.cat(rewards, 1), deter, stoch.float()


def _step(
    weights: Weights, deter: Tensor, rounded: Tensor, stoch: Tensor, by_action: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The next deter in float32 and in the products' dtype, and the mean of the prior.

    Args:
        weights: Converted weights.
        deter: Deterministic state in float32, (rows, deter).
        rounded: Deterministic state in the products' dtype, (rows, deter).
        stoch: Latent in the products' dtype, (rows, latent).
        by_action: Product of the action with its weights, (rows, hidden).
    """
    hidden = norm_silu(torch.addmm(by_action, stoch, weights.stoch), weights.input_norm)
    deter, rounded = gates(torch.cat([hidden, rounded], -1) @ weights.gates, weights.gates_norm, deter)
    hidden = _apply_layer(rounded, weights.prior, weights.prior_norm)
    return deter, rounded, torch.addmm(weights.mean_shift, hidden, weights.mean)


def _predict_rewards(weights: Weights, per_step: list[Tensor]) -> Tensor:
    """Rewards (rows, step) at the features of some steps, (rows, feature) each."""
    features = torch.cat(per_step)
    for weight, norm in weights.head:
        features = _apply_layer(features, weight, norm)
    logits = torch.addmm(weights.logits_shift, features.float(), weights.logits)
    return expectation(logits, weights.values).unflatten(0, (len(per_step), -1)).t()


def _apply_layer(features: Tensor, weight: Tensor, norm: Norm) -> Tensor:
    return norm_silu(features @ weight, norm)
