"""RSSM: a deterministic GRU state beside a Gaussian latent (Hafner et al. 2019, section 3)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from latentplan.models.heads import NormedLinear

MIN_STD = 0.1
UPDATE_SHIFT = 1.0  # below which the update gate starts: states last


class State(NamedTuple):
    """Where the model believes the world is: `deter` (rows, deter) and `stoch` (rows, latent)."""

    deter: Tensor
    stoch: Tensor

    @property
    def features(self) -> Tensor:
        """Both parts side by side, (..., deter + latent): what every head reads."""
        return torch.cat(self, -1)


class Gaussian(NamedTuple):
    """A diagonal Gaussian: `mean` and `std`, (..., latent) each, float32."""

    mean: Tensor
    std: Tensor


class Rssm(nn.Module):
    """Latent dynamics: one step, the prior without a frame, the posterior with one, and whole sequences."""

    def __init__(self, latent_dim: int, deter_dim: int, hidden_dim: int, action_dim: int, embedding_dim: int) -> None:
        super().__init__()
        self.latent_dim, self.deter_dim = latent_dim, deter_dim
        self.input = NormedLinear(latent_dim + action_dim, hidden_dim)
        self.gates = nn.Linear(hidden_dim + deter_dim, 3 * deter_dim, bias=False)
        self.gates_norm = nn.LayerNorm(3 * deter_dim)
        self.prior_hidden = NormedLinear(deter_dim, hidden_dim)
        self.prior_output = nn.Linear(hidden_dim, 2 * latent_dim)
        self.posterior_deter = nn.Linear(deter_dim, embedding_dim, bias=False)
        self.posterior_norm = nn.LayerNorm(embedding_dim)
        self.posterior_output = nn.Linear(embedding_dim, 2 * latent_dim)

    def initial(self, rows: int) -> State:
        """The state before anything was seen or done: zeros."""
        weight = self.prior_output.weight
        return State(weight.new_zeros(rows, self.deter_dim), weight.new_zeros(rows, self.latent_dim))

    def advance(self, state: State, action: Tensor) -> Tensor:
        """The next deterministic state (rows, deter) after action (rows, action)."""
        hidden = self.input(torch.cat([state.stoch, action], -1))
        gates = self.gates_norm(self.gates(torch.cat([hidden, state.deter.to(hidden.dtype)], -1)))
        return next_deter(gates, state.deter)

    def prior(self, deter: Tensor) -> Gaussian:
        """What the latent will be, judged from the past alone, for deter (..., deter)."""
        return gaussian(self.prior_output(self.prior_hidden(deter)))

    def posterior(self, deter: Tensor, embedding: Tensor) -> Gaussian:
        """What the latent is, given deter (..., deter) and the frame's embedding (..., embedding)."""
        hidden = functional.silu(self.posterior_norm(self.posterior_deter(deter) + embedding))
        return gaussian(self.posterior_output(hidden))

    def observe(self, embeddings: Tensor, actions: Tensor, deter: Tensor, noise: Tensor) -> tuple[State, Gaussian]:
        """Follow a sequence of frames.

        Args:
            embeddings: Of the frames, (batch, time + 1, embedding).
            actions: Taken between them, in [-1, 1], (batch, time, action).
            deter: Deterministic state at the first frame, (batch, deter).
            noise: Standard normal draws for the latents, (batch, time + 1, latent).

        Returns:
            The states and their posteriors, (batch, time + 1, ...) each.
        """
        deters: list[Tensor] = []
        stochs: list[Tensor] = []
        posteriors: list[Gaussian] = []
        # Unbound at once: the gradient of each slice by itself would be a whole tensor of zeros.
        for time, (embedding, draws) in enumerate(zip(embeddings.unbind(1), noise.unbind(1), strict=True)):
            if time > 0:
                deter = self.advance(State(deter, stochs[-1]), actions[:, time - 1])
            posterior = self.posterior(deter, embedding)
            deters.append(deter)
            stochs.append(posterior.mean + posterior.std * draws)
            posteriors.append(posterior)
        means, stds = (torch.stack(part, 1) for part in zip(*posteriors, strict=True))
        return State(torch.stack(deters, 1), torch.stack(stochs, 1)), Gaussian(means, stds)

    def follow(self, start: State, actions: Tensor) -> tuple[Tensor, Gaussian]:
        """Predict without looking: each step goes on from the mean of the prior.

        Args:
            start: States, (rows, ...) each.
            actions: In [-1, 1], (rows, time, action).

        Returns:
            Deterministic states and priors after each action, (rows, time, ...) each.
        """
        state, deters, priors = start, [], []
        for action in actions.unbind(1):
            deters.append(self.advance(state, action))
            priors.append(self.prior(deters[-1]))
            state = State(deters[-1], priors[-1].mean)
        means, stds = (torch.stack(part, 1) for part in zip(*priors, strict=True))
        return torch.stack(deters, 1), Gaussian(means, stds)


def kl_divergence(left: Gaussian, right: Gaussian) -> Tensor:
    """KL(left || right) in nats, summed over the latent: (...)."""
    ratio = (left.std / right.std).square()
    distance = ((left.mean - right.mean) / right.std).square()
    return 0.5 * (ratio + distance - 1.0 - ratio.log()).sum(-1)


def next_deter(gates: Tensor, deter: Tensor) -> Tensor:
    """The deterministic state (rows, deter) that normed gates (rows, 3 deter) lead to: reset, candidate and update."""
    reset, candidate, update = gates.chunk(3, -1)
    candidate = torch.tanh(torch.sigmoid(reset) * candidate)
    return torch.lerp(deter, candidate.to(deter.dtype), torch.sigmoid(update - UPDATE_SHIFT).to(deter.dtype))


def gaussian(raw: Tensor) -> Gaussian:
    """The latent's distribution, for what a layer returned (..., 2 latent); std in 0.1 to 2.1."""
    mean, raw_std = raw.float().chunk(2, -1)
    return Gaussian(mean, 2.0 * torch.sigmoid(raw_std / 2.0) + MIN_STD)
