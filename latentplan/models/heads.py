"""Heads on the latent state: distributional scalars, a continue logit, and the actor.

Trunks may run in bfloat16 under autocast. Every head computes its last layer in float32, because at a value of 500 one
bfloat16 step is larger than the differences that a planner has to distinguish.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

MIN_ACTION_STD = 0.1
MAX_ACTION_STD = 1.0
SYMLOG_LIMIT = 9.0
LARGEST_SCALAR = math.exp(SYMLOG_LIMIT) - 1.0  # about 8,100; larger targets saturate


class NormedLinear(nn.Module):
    """A linear layer, a layer norm and a SiLU."""

    def __init__(self, in_features: int, out_features: int) -> None:
        super().__init__()
        self.linear = nn.Linear(in_features, out_features, bias=False)
        self.norm = nn.LayerNorm(out_features)

    def forward(self, features: Tensor) -> Tensor:
        """Outputs (..., out) for features (..., in)."""
        return functional.silu(self.norm(self.linear(features)))


class Mlp(nn.Module):
    """Two normed hidden layers and a linear output that is never computed in less than float32."""

    def __init__(self, in_features: int, hidden_dim: int, out_features: int, output_scale: float = 1.0) -> None:
        super().__init__()
        self.trunk = nn.Sequential(NormedLinear(in_features, hidden_dim), NormedLinear(hidden_dim, hidden_dim))
        self.output = nn.Linear(hidden_dim, out_features)
        with torch.no_grad():
            self.output.weight.mul_(output_scale)
            self.output.bias.zero_()

    def forward(self, features: Tensor) -> Tensor:
        """Outputs, float32 (..., out), for features (..., in)."""
        hidden = self.trunk(features)
        with torch.autocast(hidden.device.type, enabled=False):
            return self.output(single_or_double(hidden))


class ScalarHead(nn.Module):
    """A distribution over a scalar: categorical over bins even in symlog space (Hafner et al. 2023, eqs. 8 to 10)."""

    bins: Tensor
    values: Tensor

    def __init__(self, in_features: int, hidden_dim: int, num_bins: int) -> None:
        super().__init__()
        self.mlp = Mlp(in_features, hidden_dim, num_bins, output_scale=0.0)
        self.register_buffer("bins", torch.linspace(-SYMLOG_LIMIT, SYMLOG_LIMIT, num_bins), persistent=False)
        self.register_buffer("values", symexp(self.bins), persistent=False)

    def forward(self, features: Tensor) -> Tensor:
        """Logits of the bins, float32 (..., bin), for features (..., in)."""
        return self.mlp(features)

    def mean(self, logits: Tensor) -> Tensor:
        """Expected scalar (...) under logits (..., bin), in the scalar's own unit."""
        return (logits.softmax(-1) * self.values).sum(-1)

    def loss(self, logits: Tensor, target: Tensor) -> Tensor:
        """Cross-entropy (...) to the two bins around each target (...), weighted so that their mean is the target."""
        position = torch.searchsorted(self.values, target.contiguous()).clamp(1, len(self.values) - 1)
        below, above = self.values[position - 1], self.values[position]
        weight_above = ((target - below) / (above - below)).clamp(0.0, 1.0)
        log_probs = logits.log_softmax(-1)
        log_below = log_probs.gather(-1, (position - 1).unsqueeze(-1)).squeeze(-1)
        log_above = log_probs.gather(-1, position.unsqueeze(-1)).squeeze(-1)
        return -((1.0 - weight_above) * log_below + weight_above * log_above)


class Actor(nn.Module):
    """A Gaussian over actions whose mean lies in [-1, 1] and whose std in [0.1, 1]; samples are clamped."""

    def __init__(self, in_features: int, hidden_dim: int, action_dim: int) -> None:
        super().__init__()
        self.mlp = Mlp(in_features, hidden_dim, 2 * action_dim, output_scale=0.01)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and std of the action, float32 (..., action) each, for features (..., in)."""
        return action_distribution(self.mlp(features))


def single_or_double(values: Tensor) -> Tensor:
    """The values in float32, or in float64 if they are float64."""
    return values.to(torch.promote_types(values.dtype, torch.float32))


def action_distribution(raw: Tensor) -> tuple[Tensor, Tensor]:
    """Mean in [-1, 1] and std in [0.1, 1] of the action, (..., action) each, for an actor's output (..., 2 action)."""
    mean, raw_std = raw.chunk(2, -1)
    std = (MAX_ACTION_STD - MIN_ACTION_STD) * torch.sigmoid(raw_std + 2.0) + MIN_ACTION_STD
    return torch.tanh(mean), std


def sample_action(mean: Tensor, std: Tensor, noise: Tensor) -> Tensor:
    """Reparametrised action in [-1, 1], (..., action); the clamp passes gradients straight through."""
    raw = mean + std * noise
    return raw - (raw - raw.clamp(-1.0, 1.0)).detach()


def symexp(values: Tensor) -> Tensor:
    """The inverse of symlog, sign(x) (exp(abs(x)) - 1), of each value."""
    return torch.sign(values) * torch.expm1(values.abs())
