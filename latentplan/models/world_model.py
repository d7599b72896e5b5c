"""The world model: encoder, latent dynamics and heads, and the planner's view of them."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from latentplan.config import ModelConfig
from latentplan.models import fused
from latentplan.models.decoder import Decoder
from latentplan.models.dynamics import Rssm, State
from latentplan.models.encoder import Encoder
from latentplan.models.heads import Actor, Mlp, ScalarHead, sample_action
from latentplan.models.imagination import Weights, asks_for_gradients, follow_actor, imagine, lay_out

PROBE_SHARE = 3  # quantities lie near the surface of the latent: a narrow head reads them


class WorldModel(nn.Module):
    """Everything an agent needs to see, imagine, judge and act.

    Args:
        config: Sizes.
        action_dim: Size of the action, taken from the environment.
        labels: Quantities to read off the latent, and the typical size of each.

    The methods `step`, `rollout`, `value`, `policy` and `continues` are the planner's protocol. They follow the
    mean of the prior, so that a plan's return is a function of its actions alone.
    """

    label_scales: Tensor

    def __init__(self, config: ModelConfig, action_dim: int, labels: Mapping[str, float] | None = None) -> None:
        super().__init__()
        self.config, self.action_dim, self.labels = config, action_dim, dict(labels or {})
        embedding_dim, features = config.hidden_dim, config.deter_dim + config.latent_dim
        self.encoder = Encoder(config.encoder_channels, embedding_dim)
        self.dynamics = Rssm(config.latent_dim, config.deter_dim, config.hidden_dim, action_dim, embedding_dim)
        self.decoder = Decoder(features, config.decoder_channels)
        self.reward_head = ScalarHead(features, config.hidden_dim, config.num_bins)
        self.continue_head = Mlp(features, config.hidden_dim, 1)
        self.value_head = ScalarHead(features, config.hidden_dim, config.num_bins)
        self.actor = Actor(features, config.hidden_dim, action_dim)
        self._laid_out: Weights | None = None
        self._kept: tuple[Hashable, Weights] | None = None
        self.register_buffer("label_scales", torch.tensor(list(self.labels.values())), persistent=False)
        if self.labels:
            self.probe_head = Mlp(features, max(1, config.hidden_dim // PROBE_SHARE), len(self.labels))

    def trunk_precision(self, *, cache: bool = True) -> AbstractContextManager[None]:
        """Autocast to bfloat16 for the products in the trunk; heads leave it by themselves.

        Args:
            cache: Whether converted weights are kept while it lasts. All threads share one store, which each empties
                when it leaves: what learns in two threads must not use it, or rounding would depend on timing.
        """
        return torch.autocast(self.device.type, dtype=torch.bfloat16, cache_enabled=cache)

    @contextmanager
    def planning(self) -> Iterator[None]:
        """For one search: the trunk's precision, and weights laid out for it; none may change meanwhile.

        Weights are laid out anew when one was written to in place or replaced since the last search. Writing through
        `parameter.data` goes unseen.
        """
        with self.trunk_precision():
            key = self._planned_with()
            if self._kept is None or key is None or self._kept[0] != key:
                self._kept = (key, self._weights())
            self._laid_out = self._kept[1]
            try:
                yield
            finally:
                self._laid_out = None

    @property
    def device(self) -> torch.device:
        """Where the parameters live."""
        return self.dynamics.prior_output.weight.device

    @property
    def label_names(self) -> tuple[str, ...]:
        """What `probe` reads, in order; empty where the environment told no quantities."""
        return tuple(self.labels)

    def probe(self, features: Tensor) -> Tensor:
        """The quantities `label_names` at states with features (..., feature), in their own units, (..., label).

        Raises:
            ValueError: The model was trained without labels.
        """
        if not self.labels:
            raise ValueError("this model was trained without labels, so no quantity can be read off its latent")
        return self.probe_head(features) * self.label_scales

    def infer(self, state: State, action: Tensor, frames: Tensor) -> State:
        """The belief after acting and seeing: posterior mean after `action` (rows, action) led to `frames`.

        Args:
            state: Belief before the action.
            action: In [-1, 1], (rows, action).
            frames: uint8 (rows, 64, 64, 3).
        """
        return self.see(self.dynamics.advance(state, action), frames)

    def see(self, deter: Tensor, frames: Tensor) -> State:
        """The belief with posterior mean for deter (rows, deter) and uint8 frames (rows, 64, 64, 3)."""
        return State(deter, self.dynamics.posterior(deter, self.encoder(frames)).mean)

    def step(self, state: State, action: Tensor) -> tuple[State, Tensor]:
        """Imagine one decision: the next state, and the reward (rows,) that arrives with it."""
        if self._packed_for(*state, action) is not None:
            rewards, following = self.rollout(state, action.unsqueeze(1))
            return following, rewards.squeeze(1)
        with self.trunk_precision():
            following = self._advance_mean(state, action)
            return following, self.reward_head.mean(self.reward_head(following.features))

    def rollout(self, state: State, actions: Tensor) -> tuple[Tensor, State]:
        """Imagine action sequences (rows, horizon, action): rewards (rows, horizon) and the last state."""
        return imagine(self._weights(), state, actions)

    def propose(self, state: State, num: int, horizon: int, generators: Sequence[torch.Generator]) -> Tensor:
        """What the actor does from each state, its mode first and then samples, (batch num, horizon, action).

        Args:
            state: Rows (batch,).
            num: Sequences from each.
            horizon: Model steps.
            generators: One stream per row, so that samples do not depend on who shares the call.
        """
        draws = [
            torch.randn(num, horizon, self.action_dim, generator=generator, device=self.device)
            for generator in generators
        ]
        noise = torch.stack(draws)
        noise[:, 0] = 0.0
        repeated = State(*(part.repeat_interleave(num, 0) for part in state))
        return follow_actor(self._weights(), repeated, noise.flatten(0, 1))

    def value(self, state: State) -> Tensor:
        """Expected discounted return from a state on, (rows,)."""
        packed = self._packed_for(*state)
        if packed is not None:
            return fused.judge(packed, *state)
        with self.trunk_precision():
            return self.value_head.mean(self.value_head(state.features))

    def policy(self, state: State, generator: torch.Generator | None = None) -> Tensor:
        """The actor's action (rows, action): a sample when a generator is given, else its mode."""
        with self.trunk_precision():
            mean, std = self.actor(state.features)
        if generator is None:
            return mean
        return sample_action(mean, std, torch.randn(mean.shape, generator=generator, device=mean.device))

    def continues(self, state: State) -> Tensor:
        """Probability (rows,) that the episode goes on at a state."""
        with self.trunk_precision():
            return torch.sigmoid(self.continue_head(state.features)).squeeze(-1)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_kept": None}  # it points into memory

    def _planned_with(self) -> Hashable:
        """What the weights that searches use are known by; None where torch does not count their changes."""
        parameters = [*self.dynamics.parameters(), *self.reward_head.parameters(), *self.value_head.parameters()]
        parameters += self.actor.parameters()
        if any(parameter.is_inference() for parameter in parameters):
            return None
        return tuple((parameter.data_ptr(), parameter._version) for parameter in parameters)

    def _packed_for(self, *tensors: Tensor) -> fused.Packed | None:
        """What compiled rollouts read, while a search is on and no gradient is asked for."""
        return None if self._laid_out is None or asks_for_gradients(*tensors) else self._laid_out.packed

    def _weights(self) -> Weights:
        """Weights laid out for imagination; gradients do not pass through them."""
        if self._laid_out is not None:
            return self._laid_out
        kind = self.device.type
        with self.trunk_precision():
            dtype = torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else torch.float32
        return lay_out(self.dynamics, self.reward_head, self.value_head, self.actor, dtype)

    def _advance_mean(self, state: State, action: Tensor) -> State:
        deter = self.dynamics.advance(state, action)
        return State(deter, self.dynamics.prior(deter).mean)
