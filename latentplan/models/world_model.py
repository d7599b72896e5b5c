"""The world model: encoder, latent dynamics, decoder and heads, with the methods that a planner calls."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager

import torch
from torch import Tensor, nn

from latentplan.config import ModelConfig
from latentplan.config.checks import UserError
from latentplan.config.quantities import TASK_PREFIX
from latentplan.config.spaces import Spaces
from latentplan.models.backend import Backend
from latentplan.models.decoder import Decoder
from latentplan.models.dynamics import Dynamics, Rssm, State, surprise
from latentplan.models.encoder import Encoder, Observation
from latentplan.models.goal_heads import GoalHeads
from latentplan.models.heads import Actor, MixedActor, Mlp, ScalarHead, sample_action

PROBE_SHARE = 3  # the probe has a third of the width of other heads, because quantities are easy to predict


class WorldModel(nn.Module):
    """Encoder, latent dynamics, decoder and heads.

    The methods `step`, `fast_step`, `rollout`, `propose`, `value`, `policy` and `continues` are the planner's protocol.
    They continue from the mean of the prior, so that a plan's return depends on its actions alone.

    Args:
        config: Sizes of the networks.
        action_dim: Size of the action, taken from the environment.
        labels: Names and typical sizes of the quantities that `probe` predicts from the latent.
        goal_dim: Width of the heads for goals (`GoalHeads`), which are trained after everything else; 0 for none.
        spaces: Shape of frames, and which numbers of the action stand for categories; None takes the usual ones.

    Attributes:
        backend: Computes steps, rollouts and beliefs; the reference, or a faster one that `accelerate` chose.
    """

    label_scales: Tensor

    def __init__(
        self,
        config: ModelConfig,
        action_dim: int,
        labels: Mapping[str, float] | None = None,
        goal_dim: int = 0,
        spaces: Spaces | None = None,
    ) -> None:
        super().__init__()
        self.spaces = spaces = spaces or Spaces()
        if spaces.choices and len(spaces.choices) != action_dim:
            raise ValueError(f"choices {spaces.choices} must have one entry for each of {action_dim} numbers")
        if any(spaces.choices) and config.turns > 1:
            raise UserError("model.turns 4 needs continuous actions, whose mean over turns is an action: set it to 1")
        if spaces.vector_dim and config.turns > 1:
            raise UserError("model.turns 4 turns pictures, and env.vectors cannot be turned: leave one of them out")
        self.config, self.action_dim, self.labels = config, action_dim, dict(labels or {})
        embedding_dim, features = config.hidden_dim, config.deter_dim + config.latent_dim
        self.encoder = Encoder(
            config.encoder_channels, embedding_dim, spaces.frame_shape, spaces.vector_dim, config.hidden_dim
        )
        self.dynamics: Dynamics = Rssm(
            config.latent_dim, config.deter_dim, config.hidden_dim, action_dim, embedding_dim, spaces.choices
        )
        self.decoder = Decoder(
            features,
            config.decoder_channels,
            spaces.frame_shape,
            config.decoder_width,
            config.decoder_layers,
        )
        self.reward_head = ScalarHead(features, config.hidden_dim, config.num_bins)
        self.continue_head = Mlp(features, config.hidden_dim, 1)
        self.value_head = ScalarHead(features, config.hidden_dim, config.num_bins)
        self.actor: Actor | MixedActor = (
            MixedActor(features, config.hidden_dim, spaces.choices)
            if any(spaces.choices)
            else Actor(features, config.hidden_dim, action_dim)
        )
        self.backend = Backend()
        self.register_buffer("label_scales", torch.tensor(list(self.labels.values())), persistent=False)
        if spaces.vector_dim:
            self.vector_head = Mlp(features, config.hidden_dim, spaces.vector_dim)
        if self.labels:
            self.probe_head = Mlp(features, max(1, config.hidden_dim // PROBE_SHARE), len(self.labels))
        self.goal_dim = 0
        if goal_dim:
            self.add_goal_heads(goal_dim)
        self.float()  # whatever torch's default dtype

    def trunk_precision(self, *, cache: bool = True) -> AbstractContextManager[None]:
        """A context in which matrix products use `trunk_dtype`; the last layers of heads use float32.

        Args:
            cache: Whether autocast keeps converted weights until the context ends. All threads share one cache, and
                each thread empties it on exit. Two threads that learn must not use it, or rounding depends on timing.
        """
        dtype = self.trunk_dtype
        return torch.autocast(self.device.type, dtype, enabled=dtype != torch.float32, cache_enabled=cache)

    @property
    def trunk_dtype(self) -> torch.dtype:
        """Precision of the matrix products outside the last layers of heads; the backend sets it."""
        return self.backend.trunk_dtype

    @property
    def device(self) -> torch.device:
        """The device of the parameters."""
        return self.label_scales.device

    @property
    def has_choices(self) -> bool:
        """Whether some numbers of the action stand for categories."""
        return isinstance(self.actor, MixedActor)

    @property
    def label_names(self) -> tuple[str, ...]:
        """The quantities that `probe` predicts, in order; empty for an environment without quantities."""
        return tuple(self.labels)

    @property
    def goal_names(self) -> tuple[str, ...]:
        """The quantities that goals can name, in the order of `goal_quantities`: all labels but rewards of tasks."""
        return tuple(name for name in self.labels if not name.startswith(TASK_PREFIX))

    @property
    def goal_scales(self) -> Tensor:
        """The typical size of each of `goal_names`, (quantity,)."""
        return self.label_scales[: len(self.goal_names)]

    def add_goal_heads(self, goal_dim: int) -> None:
        """Adds untrained heads for goals to the model.

        Args:
            goal_dim: Width of their hidden layers.

        Raises:
            ValueError: The model was trained without labels.
            UserError: The model has discrete actions, or sees vectors.
        """
        if self.has_choices:
            raise UserError("goals are learned for continuous actions only: let the planner pursue them (--objective)")
        if self.spaces.vector_dim:
            raise UserError("goals are learned from pictures alone, without env.vectors: let the planner pursue them")
        if not self.goal_names:
            raise ValueError("this model was trained without labels, so it has no quantities that a goal could name")
        features, config = self.config.deter_dim + self.config.latent_dim, self.config
        heads = GoalHeads(features, goal_dim, self.action_dim, config.num_bins, self.goal_scales.clone()).float()
        self.goal_dim, self.goal_heads = goal_dim, heads.to(self.device)

    def goal_action(self, features: Tensor, code: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and std of the action, (..., action) each, for goals given by their code; see `GoalHeads.act`."""
        mean, std = self.goal_heads.act(features, code, self.actor.mlp(features))
        return mean, std

    def goal_quantities(self, features: Tensor) -> Tensor:
        """Predictions of the quantities `goal_names` for features (..., feature), float32 (..., quantity)."""
        return self.probe(features)[..., : len(self.goal_names)].float()

    def seen_vectors(self, labels: Tensor) -> Tensor:
        """The numbers beside the frames, (..., vector), which lie behind the labels, (..., label + vector)."""
        return labels[..., len(self.labels) :]

    def probe(self, features: Tensor) -> Tensor:
        """Predictions of the quantities `label_names` for features (..., feature), in their own units, (..., label).

        Raises:
            ValueError: The model was trained without labels.
        """
        if not self.labels:
            raise ValueError("this model was trained without labels, so it predicts no quantities")
        return self.probe_head(features) * self.label_scales

    def infer(self, state: State, action: Tensor, frames: Tensor | Observation) -> State:
        """The belief, with the posterior's mean, after actions and the frames that resulted.

        Args:
            state: The belief before the action.
            action: Actions in [-1, 1], (rows, action).
            frames: Frames after the actions, uint8 (rows, height, width, channel).
        """
        return self.see(self.dynamics.advance(state, action), frames)

    def see(self, deter: Tensor, frames: Tensor | Observation) -> State:
        """The belief with the posterior's mean for deter (rows, deter) and frames, as in `infer`."""
        return State(deter, self.dynamics.posterior(deter, self.encoder(frames)).mean)

    def step(self, state: State, action: Tensor) -> tuple[State, Tensor]:
        """The state after action (rows, action), by the mean of the prior, and the reward (rows,) of the step."""
        return self.backend.step(self, state, action)

    def fast_step(self, state: State, action: Tensor) -> tuple[State, Tensor]:
        """The same as `step` up to rounding, faster, for rows in dim 0 and without gradients."""
        return self.backend.fast_step(self, state, action)

    def rollout(self, state: State, actions: Tensor) -> tuple[Tensor, State]:
        """Rewards (rows, horizon) along action sequences (rows, horizon, action), and the last state."""
        return self.backend.rollout(self, state, actions)

    def propose(self, state: State, num: int, horizon: int, generators: Sequence[torch.Generator]) -> Tensor:
        """Action sequences of the actor from each state, its mode first, then samples, (batch num, horizon, action).

        Args:
            state: The start of the sequences, (batch, ...).
            num: Sequences per state.
            horizon: Model steps.
            generators: One random stream per state, so that samples do not depend on the other states of the call.
        """
        draws = [
            torch.randn(num, horizon, self.action_dim, generator=generator, device=self.device, dtype=torch.float32)
            for generator in generators
        ]
        noise = torch.stack(draws)
        noise[:, 0] = 0.0
        repeated = State(*(part.repeat_interleave(num, 0) for part in state))
        return self.backend.propose(self, repeated, noise.flatten(0, 1))

    def value(self, state: State) -> Tensor:
        """The expected discounted return from a state on, (rows,)."""
        return self.backend.value(self, state)

    def policy(self, state: State, generator: torch.Generator | None = None) -> Tensor:
        """The actor's action (rows, action): a sample when a generator is given, else its mode."""
        with self.trunk_precision():
            if generator is None:
                mean, _ = self.actor(state.features)
                return mean
            shape = *state.deter.shape[:-1], self.action_dim
            noise = torch.randn(shape, generator=generator, device=state.deter.device, dtype=torch.float32)
            if isinstance(self.actor, MixedActor):
                return self.actor.sample(state.features, noise)
            mean, std = self.actor(state.features)
        return sample_action(mean, std, noise)

    def continues(self, state: State) -> Tensor:
        """The probability (rows,) that the episode continues at a state."""
        with self.trunk_precision():
            return torch.sigmoid(self.continue_head(state.features)).squeeze(-1)

    def surprise(self, state: State) -> Tensor:
        """The surprise of beliefs in nats, (rows,): the distance of the latent from the prior.

        Surprise is half the squared distance between the latent and the prior's mean, in standard deviations of the
        prior.
        """
        return surprise(state.stoch, self.dynamics.prior(state.deter))
