"""Heads on the latent state: distributional scalars, a continue logit, and the actor.

Trunks may run in bfloat16 under autocast. Every head computes its last layer in float32, because at a value of 500 one
bfloat16 step is larger than the differences that a planner has to distinguish.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from latentplan.config.learning import SYMLOG_LIMIT

MIN_ACTION_STD = 0.1
MAX_ACTION_STD = 1.0
UNIFORM_SHARE = 0.01  # of each categorical distribution (Hafner et al. 2023), so that every category stays possible
HALF_LOG_2_PI_E = 1.4189385  # entropy of a Gaussian is log std + this, in nats


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


class ActionCode(nn.Module):
    """Actions as inputs of a network: continuous numbers as they are, and a one-hot vector for each category.

    Args:
        choices: See `latentplan.config.spaces.Spaces`; at least one number stands for a category.

    Attributes:
        size: Numbers of a code.
        continuous: Places of the continuous numbers in an action, (continuous,).
        discrete: Places of the numbers that stand for a category, (discrete,).
        exists: Whether each discrete number has each category, bool (discrete, category).
    """

    continuous: Tensor
    discrete: Tensor
    exists: Tensor
    counts: Tensor
    categories: Tensor
    hot: Tensor
    order: Tensor

    def __init__(self, choices: Sequence[int]) -> None:
        super().__init__()
        integers: dict[str, Any] = {"dtype": torch.long, "device": "cpu"}  # also where weights are made on another
        counts = torch.tensor([num for num in choices if num], **integers)
        categories = torch.arange(max(choices), **integers)
        places = {
            "continuous": torch.tensor([place for place, num in enumerate(choices) if not num], **integers),
            "discrete": torch.tensor([place for place, num in enumerate(choices) if num], **integers),
            "counts": counts,
            "categories": categories,
            "exists": categories < counts[:, None],
            "hot": (categories < counts[:, None]).flatten().nonzero()[:, 0],  # a mask would stop a CUDA graph
        }
        places["order"] = torch.cat([places["continuous"], places["discrete"]]).argsort()
        for name, value in places.items():
            self.register_buffer(name, value, persistent=False)
        self.size = sum(num or 1 for num in choices)

    def forward(self, actions: Tensor) -> Tensor:
        """Codes (..., size) of actions (..., action) in [-1, 1]; a number that is NaN gives NaN."""
        given = actions[..., self.discrete]
        is_taken = (self.find(actions)[..., None] == self.categories).to(actions.dtype) + 0.0 * given[..., None]
        return torch.cat([actions[..., self.continuous], is_taken.flatten(-2)[..., self.hot]], -1)

    def find(self, actions: Tensor) -> Tensor:
        """The category that each discrete number stands for, int64 (..., discrete)."""
        place = (actions[..., self.discrete].nan_to_num() + 1.0) * 0.5 * self.counts
        return torch.minimum(place.floor().long().clamp_min(0), self.counts - 1)

    def values(self, categories: Tensor) -> Tensor:
        """The number in [-1, 1] that stands for each category, float32 (..., discrete)."""
        return (2.0 * categories + 1.0) / self.counts - 1.0

    def join(self, continuous: Tensor, discrete: Tensor) -> Tensor:
        """Actions (..., action) from continuous numbers (..., continuous) and discrete numbers (..., discrete)."""
        return torch.cat([continuous, discrete.to(continuous.dtype)], -1)[..., self.order]


class MixedActor(nn.Module):
    """A categorical distribution over each choice of an action, and a Gaussian over each continuous number.

    Samples come from standard normal noise, one number for each number of the action: a category is the one in whose
    part of the cumulated probabilities the normal quantile of the noise lies. Noise of exactly 0 gives the mode.

    Args:
        in_features: Size of the features.
        hidden_dim: Width of the hidden layers.
        choices: See `latentplan.config.spaces.Spaces`; at least one number stands for a category.
    """

    places: Tensor

    def __init__(self, in_features: int, hidden_dim: int, choices: Sequence[int]) -> None:
        super().__init__()
        self.code = ActionCode(choices)
        self.num_continuous = 2 * len(self.code.continuous)
        exists = self.code.exists
        self.mlp = Mlp(in_features, hidden_dim, self.num_continuous + int(exists.sum()), output_scale=0.01)
        places = (exists.flatten().cumsum(0) - 1).clamp_min(0).view(exists.shape)
        self.register_buffer("places", places, persistent=False)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Mode and std of the action, float32 (..., action) each, for features (..., in); NaN features give NaN."""
        mean, std, logits = self._distribution(features)
        probabilities = logits.softmax(-1)
        values = torch.where(self.code.exists, self.code.values(self.code.categories[:, None]).T, 0.0)
        average = (probabilities * values).sum(-1)
        spread = ((probabilities * values.square()).sum(-1) - average.square()).clamp_min(0.0).sqrt()
        return self.code.join(mean, self._values(logits.argmax(-1), logits)), self.code.join(std, spread)

    def sample(self, features: Tensor, noise: Tensor) -> Tensor:
        """Actions in [-1, 1] for standard normal noise, float32 (..., action) each; categories pass no gradient.

        NaN features give NaN.
        """
        mean, std, logits = self._distribution(features)
        continuous = sample_action(mean, std, noise[..., self.code.continuous])
        drawn = noise[..., self.code.discrete]
        quantile = torch.special.ndtr(drawn)[..., None]
        category = torch.minimum((logits.softmax(-1).cumsum(-1) < quantile).sum(-1), self.code.counts - 1)
        category = torch.where(drawn == 0.0, logits.argmax(-1), category)
        return self.code.join(continuous, self._values(category, logits))

    def score(self, features: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Log-probability of actions (..., action), and entropy of the distribution in nats, (...) each.

        A continuous number at a bound has the probability of all samples that the clamp moves there, which makes the
        mean of the score's gradient 0 as for any distribution. The entropy is that of the Gaussian.
        """
        mean, std, logits = self._distribution(features)
        log_probs = logits.log_softmax(-1)
        taken = log_probs.gather(-1, self.code.find(actions)[..., None])[..., 0].sum(-1)
        entropy = -(log_probs.exp() * log_probs.masked_fill(~self.code.exists, 0.0)).sum((-2, -1))
        numbers = actions[..., self.code.continuous]
        density = -0.5 * ((numbers - mean) / std).square() - std.log() + 0.5 - HALF_LOG_2_PI_E
        beyond = torch.special.log_ndtr((numbers.sign() * mean - 1.0) / std)
        density = torch.where(numbers.abs() < 1.0, density, beyond).sum(-1)
        return taken + density, entropy + (std.log() + HALF_LOG_2_PI_E).sum(-1)

    def _values(self, categories: Tensor, logits: Tensor) -> Tensor:
        """The number of each category, (..., discrete); NaN where the logits (..., discrete, category) are NaN."""
        # Every choice has a first category, and a softmax spreads the NaN of one logit to all.
        return self.code.values(categories).masked_fill(logits[..., 0].isnan(), torch.nan)

    def _distribution(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Mean and std of the continuous numbers, (..., continuous) each, and logits (..., discrete, category)."""
        raw = self.mlp(features)
        mean, std = action_distribution(raw[..., : self.num_continuous])
        logits = raw[..., self.num_continuous :][..., self.places].masked_fill(~self.code.exists, float("-inf"))
        mixed = (1.0 - UNIFORM_SHARE) * logits.softmax(-1) + UNIFORM_SHARE / self.code.counts[:, None]
        return mean, std, mixed.masked_fill(~self.code.exists, 1.0).log().masked_fill(~self.code.exists, float("-inf"))


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


def symlog(values: Tensor) -> Tensor:
    """sign(x) log(1 + abs(x)) of each value (Hafner et al. 2023, eq. 9)."""
    return torch.sign(values) * torch.log1p(values.abs())


def symexp(values: Tensor) -> Tensor:
    """The inverse of symlog, sign(x) (exp(abs(x)) - 1), of each value."""
    return torch.sign(values) * torch.expm1(values.abs())
