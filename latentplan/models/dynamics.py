"""Latent dynamics: the RSSM, a deterministic GRU state beside a Gaussian latent (Hafner et al. 2019, section 3)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from latentplan.models.heads import ActionCode, NormedLinear, sample_action, single_or_double

MIN_STD = 0.1
UPDATE_SHIFT = 1.0  # subtracted before the update gate's sigmoid, so that untrained states change slowly


class State(NamedTuple):
    """A latent state: the GRU's deterministic state `deter` (rows, deter), and the latent `stoch` (rows, latent)."""

    deter: Tensor
    stoch: Tensor

    @property
    def features(self) -> Tensor:
        """Both parts side by side, the input of every head, (..., deter + latent)."""
        return torch.cat(self, -1)


class Gaussian(NamedTuple):
    """A diagonal Gaussian: `mean` and `std`, (..., latent) each, float32."""

    mean: Tensor
    std: Tensor


class Dynamics(nn.Module):
    """Transitions of latent states. A subclass defines single steps; this class computes sequences of steps.

    A subclass sets `latent_dim` and `deter_dim`, and defines `advance`, `prior` and `posterior`. Everything that it
    remembers is in `deter`: one vector of `ModelConfig.deter_dim` numbers per row, zeros at the start of an episode,
    which the replay stores in float16.
    """

    latent_dim: int
    deter_dim: int

    def initial(self, rows: int) -> State:
        """The state before the first frame and the first action: zeros."""
        weight = next(self.parameters())
        return State(weight.new_zeros(rows, self.deter_dim), weight.new_zeros(rows, self.latent_dim))

    def advance(self, state: State, action: Tensor) -> Tensor:
        """The next deterministic state (rows, deter) after action (rows, action)."""
        raise NotImplementedError

    def prior(self, deter: Tensor) -> Gaussian:
        """The distribution of the latent given the past alone, for deter (..., deter)."""
        raise NotImplementedError

    def posterior(self, deter: Tensor, embedding: Tensor) -> Gaussian:
        """The distribution of the latent given deter (..., deter) and the frame's embedding (..., embedding)."""
        raise NotImplementedError

    def observe(self, embeddings: Tensor, actions: Tensor, deter: Tensor, noise: Tensor) -> tuple[State, Gaussian]:
        """Beliefs about each frame of a sequence, given the frames and actions so far.

        Args:
            embeddings: Embeddings of the frames, (batch, time + 1, embedding).
            actions: Actions between the frames, in [-1, 1], (batch, time, action).
            deter: Deterministic state at the first frame, (batch, deter).
            noise: Standard normal draws for the latents, (batch, time + 1, latent).

        Returns:
            The states and their posteriors, (batch, time + 1, ...) each.
        """
        deters: list[Tensor] = []
        stochs: list[Tensor] = []
        posteriors: list[Gaussian] = []
        # `unbind` has one gradient for all steps; a slice per step would have a whole tensor of zeros each.
        for time, (embedding, draws) in enumerate(zip(embeddings.unbind(1), noise.unbind(1), strict=True)):
            if time > 0:
                deter = self.advance(State(deter, stochs[-1]), actions[:, time - 1])
            posterior = self.posterior(deter, embedding)
            deters.append(deter)
            stochs.append(posterior.mean + posterior.std * draws)
            posteriors.append(posterior)
        means, stds = (torch.stack(part, 1) for part in zip(*posteriors, strict=True))
        return State(torch.stack(deters, 1), torch.stack(stochs, 1)), Gaussian(means, stds)

    def predict(self, start: State, actions: Tensor) -> tuple[Tensor, Gaussian]:
        """Open-loop predictions without frames: each step continues from the mean of the prior.

        Args:
            start: States, (rows, ...) each.
            actions: Actions in [-1, 1], (rows, time, action).

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

    def imagine(
        self,
        policy: Callable[[Tensor], tuple[Tensor, Tensor]],
        start: State,
        action_noise: Tensor,
        noise: Tensor,
        decay: float = 1.0,
    ) -> tuple[Tensor, Tensor]:
        """Rollouts with samples of a policy and of the prior; gradients pass through the dynamics.

        The policy reads each state without a gradient, so that the gradient of an action passes through the dynamics
        alone (Hafner et al. 2020, section 3).

        Args:
            policy: Mean and std of the action, (rows, action) each, for features (rows, feature).
            start: Start of every rollout, (rows, ...) each.
            action_noise: Standard normal draws for the actions, (horizon, rows, action).
            noise: Standard normal draws for the latents, (horizon, rows, latent).
            decay: Share of a state's gradient that a step passes back to the state before, in [0, 1]. Gradients through
                contacts grow from step to step until they carry no information (Schrittwieser et al. 2020, appendix G,
                halve them).

        Returns:
            Features, the start first, (horizon + 1, rows, feature), and std of the actions, (horizon, rows, action).
        """
        state, features, stds = start, [start.features], []
        for action_draws, draws in zip(action_noise.unbind(), noise.unbind(), strict=True):
            mean, std = policy(features[-1].detach())
            stds.append(std)
            decayed = State(*(_decay_gradient(part, decay) for part in state))
            deter = self.advance(decayed, sample_action(mean, std, action_draws))
            prior = self.prior(deter)
            state = State(deter, torch.addcmul(prior.mean, prior.std, draws))
            features.append(state.features)
        return torch.stack(features), torch.stack(stds)


class Rssm(Dynamics):
    """A GRU with a layer norm on its gates beside a Gaussian latent.

    Args:
        latent_dim: Size of the latent.
        deter_dim: Size of the GRU's state.
        hidden_dim: Width of the hidden layers.
        action_dim: Size of the action.
        embedding_dim: Size of an embedding.
        choices: Numbers of the action that stand for categories, which are read as one-hot vectors; see
            `latentplan.config.spaces.Spaces`.
    """

    def __init__(
        self,
        latent_dim: int,
        deter_dim: int,
        hidden_dim: int,
        action_dim: int,
        embedding_dim: int,
        choices: Sequence[int] = (),
    ) -> None:
        super().__init__()
        self.latent_dim, self.deter_dim = latent_dim, deter_dim
        self.code = ActionCode(choices) if any(choices) else None
        code_dim = action_dim if self.code is None else self.code.size
        self.input = NormedLinear(latent_dim + code_dim, hidden_dim)
        self.gates = nn.Linear(hidden_dim + deter_dim, 3 * deter_dim, bias=False)
        self.gates_norm = nn.LayerNorm(3 * deter_dim)
        self.prior_hidden = NormedLinear(deter_dim, hidden_dim)
        self.prior_output = nn.Linear(hidden_dim, 2 * latent_dim)
        self.posterior_deter = nn.Linear(deter_dim, embedding_dim, bias=False)
        self.posterior_norm = nn.LayerNorm(embedding_dim)
        self.posterior_output = nn.Linear(embedding_dim, 2 * latent_dim)

    def advance(self, state: State, action: Tensor) -> Tensor:
        """See `Dynamics.advance`."""
        hidden = self.input(torch.cat([state.stoch, self.read(action)], -1))
        gates = self.gates_norm(self.gates(torch.cat([hidden, state.deter.to(hidden.dtype)], -1)))
        return next_deter(gates, state.deter)

    def read(self, actions: Tensor) -> Tensor:
        """The inputs of the GRU, (..., input), for actions (..., action): the actions, with categories as one-hot."""
        return actions if self.code is None else self.code(actions)

    def prior(self, deter: Tensor) -> Gaussian:
        """See `Dynamics.prior`."""
        return gaussian(self.prior_output(self.prior_hidden(deter)))

    def posterior(self, deter: Tensor, embedding: Tensor) -> Gaussian:
        """See `Dynamics.posterior`."""
        hidden = functional.silu(self.posterior_norm(self.posterior_deter(deter) + embedding))
        return gaussian(self.posterior_output(hidden))


def kl_divergence(left: Gaussian, right: Gaussian) -> Tensor:
    """KL(left || right) in nats, summed over the latent: (...)."""
    ratio = (left.std / right.std).square()
    distance = ((left.mean - right.mean) / right.std).square()
    return 0.5 * (ratio + distance - 1.0 - ratio.log()).sum(-1)


def surprise(stoch: Tensor, prior: Gaussian) -> Tensor:
    """Half the squared distance of latents (..., latent) from the prior's mean, in standard deviations, (...)."""
    return 0.5 * ((stoch - prior.mean) / prior.std).square().sum(-1)


def next_deter(gates: Tensor, deter: Tensor) -> Tensor:
    """The next deterministic state (rows, deter) from normed reset, candidate and update gates (rows, 3 deter)."""
    reset, candidate, update = gates.chunk(3, -1)
    candidate = torch.tanh(torch.sigmoid(reset) * candidate)
    return torch.lerp(deter, candidate.to(deter.dtype), torch.sigmoid(update - UPDATE_SHIFT).to(deter.dtype))


def gaussian(raw: Tensor) -> Gaussian:
    """The latent's distribution from a layer's output (..., 2 latent); std in [0.1, 2.1]."""
    mean, raw_std = single_or_double(raw).chunk(2, -1)
    return Gaussian(mean, 2.0 * torch.sigmoid(raw_std / 2.0) + MIN_STD)


def _decay_gradient(values: Tensor, share: float) -> Tensor:
    """The same values; a share of their gradient passes."""
    return values if share == 1.0 else values.detach().lerp(values, share)
