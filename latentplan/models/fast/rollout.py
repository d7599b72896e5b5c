"""Following many action sequences by the mean of the prior: the planner's hot path.

Equals `WorldModel.step` taken again and again, with the same arithmetic arranged for speed: weights are turned and cast
once, the prior's std is left out, and rows go through in blocks that stay in the cache. Where the processor multiplies
bfloat16, a compiled call does all of it (`compiled`); elsewhere torch does, with what stands between the products fused
(`library`). Where gradients are asked for nothing is written in place, so that plans can be refined by them.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from latentplan.models.dynamics import Rssm, State
from latentplan.models.fast import compiled
from latentplan.models.fast.library import Norm, expectation, gates, norm_silu
from latentplan.models.heads import Actor, Mlp, NormedLinear, ScalarHead, action_distribution

ROWS_PER_THREAD = 1024  # what one step makes of more rows no longer fits a core's cache
BIN_MULTIPLE = 16  # float32 products with another number of columns take half as long again


Trunk = tuple[tuple[Tensor, Norm], ...]  # of an Mlp: a product and a norm for each hidden layer


class Weights(NamedTuple):
    """Recurrence, reward head and actor, laid out for products from the left: (in, out)."""

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
def lay_out(dynamics: Rssm, head: ScalarHead, critic: ScalarHead, actor: Actor, dtype: torch.dtype) -> Weights:
    """The weights of what imagines, products in `dtype`; gates' norm and the heads' outputs in float32.

    Args:
        dynamics: What rollouts follow.
        head: Of the reward.
        critic: The value head, with the same bins.
        actor: What proposes.
        dtype: Of the products.
    """

    def turn(weight: Tensor) -> Tensor:
        return weight.to(dtype).t().contiguous()

    def norm(layer: nn.LayerNorm) -> Norm:
        kind = torch.float32 if layer.weight.device.type == "cpu" else dtype  # only there the two may differ
        return layer.weight.to(kind), layer.bias.to(kind)

    def trunk(mlp: Mlp) -> Trunk:
        layers = [layer for layer in mlp.trunk if isinstance(layer, NormedLinear)]
        return tuple((turn(layer.linear.weight), norm(layer.norm)) for layer in layers)

    def logits(head: ScalarHead) -> tuple[Tensor, Tensor]:
        output, padding = head.mlp.output, (0, -len(head.values) % BIN_MULTIPLE)
        return functional.pad(output.weight.t(), padding), functional.pad(output.bias, padding, value=float("-inf"))

    latent, input_weight = dynamics.latent_dim, dynamics.input.linear.weight
    reward_logits, reward_shift = logits(head)
    weights = Weights(
        action=turn(input_weight[:, latent:]),
        stoch=turn(input_weight[:, :latent]),
        input_norm=norm(dynamics.input.norm),
        gates=turn(dynamics.gates.weight),
        gates_norm=(dynamics.gates_norm.weight.float(), dynamics.gates_norm.bias.float()),
        prior=turn(dynamics.prior_hidden.linear.weight),
        prior_norm=norm(dynamics.prior_hidden.norm),
        mean=turn(dynamics.prior_output.weight[:latent]),
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
        weights: What `lay_out` gave.
        state: Where every sequence starts, (rows, ...).
        actions: In [-1, 1], (rows, time, action).
    """
    if weights.packed is not None and not asks_for_gradients(*state, actions):
        rewards, *last = compiled.rollout(weights.packed, *state, actions)
        return rewards, State(*last)
    block = ROWS_PER_THREAD * torch.get_num_threads() if actions.device.type == "cpu" else len(actions)
    with torch.autocast(actions.device.type, enabled=False):
        blocks = zip(*(part.split(block) for part in (*state, actions)), strict=True)
        parts = [_imagine_block(weights, *rows) for rows in blocks]
    rewards, deters, stochs = (torch.cat(part) for part in zip(*parts, strict=True))
    return rewards, State(deters, stochs)


def propose(weights: Weights, state: State, noise: Tensor) -> Tensor:
    """The actions that the actor takes along the mean of the prior, float32 (rows, time, action).

    Args:
        weights: What `lay_out` gave.
        state: Where every sequence starts, (rows, ...).
        noise: Standard normal draws for its samples, zeros for its mode, (rows, time, action).
    """
    if weights.packed is not None and not asks_for_gradients(*state, noise):
        return compiled.propose(weights.packed, *state, noise)
    deter, stoch = state.deter.float(), state.stoch.to(weights.gates.dtype)
    rounded, actions = deter.to(stoch.dtype), []
    with torch.autocast(noise.device.type, enabled=False):
        for draw in noise.unbind(1):
            hidden = torch.cat([rounded, stoch], -1)
            for weight, norm in weights.actor:
                hidden = _layer(hidden, weight, norm)
            mean, std = action_distribution(torch.addmm(weights.actor_shift, hidden.float(), weights.actor_output))
            actions.append(torch.addcmul(mean, std, draw).clamp(-1.0, 1.0))
            push = actions[-1].to(stoch.dtype) @ weights.action
            deter, rounded, stoch = _step(weights, deter, rounded, stoch, push)
    return torch.stack(actions, 1)


def asks_for_gradients(*tensors: Tensor) -> bool:
    """Whether what is computed from these tensors would record how."""
    return torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)


def _imagine_block(weights: Weights, deter: Tensor, stoch: Tensor, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    dtype = weights.gates.dtype
    # Few rows take the reward head many steps at a time: one product of a thousand rows costs two of a hundred.
    steps_at_once = max(1, ROWS_PER_THREAD * torch.get_num_threads() // len(actions))
    pushes = actions.transpose(0, 1).to(dtype).contiguous() @ weights.action  # (time, rows, hidden)
    deter, rounded, stoch = deter.float(), deter.to(dtype), stoch.to(dtype)
    seen, rewards = [], []
    for push in pushes:
        deter, rounded, stoch = _step(weights, deter, rounded, stoch, push)
        seen.append(torch.cat([rounded, stoch], -1))
        if len(seen) == steps_at_once:
            rewards.append(_rewards(weights, seen))
            seen = []
    if seen:
        rewards.append(_rewards(weights, seen))
    return torch.cat(rewards, 1), deter, stoch.float()


def _step(
    weights: Weights, deter: Tensor, rounded: Tensor, stoch: Tensor, push: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The next deter, the same rounded to the products' dtype, and the mean of the prior there."""
    deter, rounded = _advance(weights, deter, rounded, stoch, push)
    hidden = _layer(rounded, weights.prior, weights.prior_norm)
    return deter, rounded, torch.addmm(weights.mean_shift, hidden, weights.mean)


def _advance(weights: Weights, deter: Tensor, rounded: Tensor, stoch: Tensor, push: Tensor) -> tuple[Tensor, Tensor]:
    """The next deter (rows, deter), float32 and rounded; `push` (rows, hidden) is the action's share of the input."""
    hidden = norm_silu(torch.addmm(push, stoch, weights.stoch), weights.input_norm)
    return gates(torch.cat([hidden, rounded], -1) @ weights.gates, weights.gates_norm, deter)


def _rewards(weights: Weights, seen: list[Tensor]) -> Tensor:
    """The reward at each of the features (rows, feature) seen: (rows, len(seen))."""
    features = torch.cat(seen)
    for weight, norm in weights.head:
        features = _layer(features, weight, norm)
    logits = torch.addmm(weights.logits_shift, features.float(), weights.logits)
    return expectation(logits, weights.values).unflatten(0, (len(seen), -1)).t()


def _layer(features: Tensor, weight: Tensor, norm: Norm) -> Tensor:
    return norm_silu(features @ weight, norm)
