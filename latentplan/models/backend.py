"""The computations of a world model that can be made faster, and their reference in plain torch.

A `WorldModel` leaves to its backend every computation that planners, agents and learners need often. `Backend` is the
reference: it works on every device, with every kind of dynamics. The backends in `latentplan.models.fast` return the
same results up to rounding; `latentplan.models.fast.accelerate` chooses the backend of a model.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from einops import rearrange
from torch import Tensor

from latentplan.models.dynamics import Gaussian, State, kl_divergence, surprise
from latentplan.models.encoder import Observation
from latentplan.models.heads import MixedActor

if TYPE_CHECKING:
    from latentplan.models.heads import Mlp, ScalarHead
    from latentplan.models.world_model import WorldModel


class FrameFunctions:
    """Belief update and actor for one frame per row, in plain torch; an agent asks for them at every decision.

    The results are float32 and carry no gradients. A faster backend computes them with the weights that the model had
    when asked.

    Args:
        model: The world model.
    """

    def __init__(self, model: WorldModel) -> None:
        # A reference to the model would close a circle, because the model's backend keeps these functions.
        self._encoder, self._dynamics, self._actor = model.encoder, model.dynamics, model.actor

    def infer(
        self, state: State, action: Tensor | None, frames: Tensor | Observation, is_first: Tensor | None = None
    ) -> State:
        """The belief, with the posterior's mean, after actions and the frames that resulted.

        Args:
            state: The belief before the action, (rows, ...).
            action: Actions in [-1, 1], (rows, action); None if `state.deter` is the state at the frame already.
            frames: Frames after the actions, uint8 (rows, 64, 64, 3) or the model's other shape, perhaps with vectors.
            is_first: Rows whose episode begins with the frame, (rows,) bool; None stands for no row.
        """
        deter = self._find_deter(state, action, is_first)
        return State(deter, self._dynamics.posterior(deter, self._encoder(frames)).mean)

    def infer_and_act(
        self, state: State, action: Tensor | None, frames: Tensor | Observation, is_first: Tensor | None = None
    ) -> tuple[State, Tensor, Tensor]:
        """The belief of `infer`, and mean and std of the actor's action at this belief; see `act`."""
        belief = self.infer(state, action, frames, is_first)
        return belief, *self.act(belief)

    def infer_and_compare(
        self, state: State, action: Tensor | None, frames: Tensor | Observation, is_first: Tensor | None = None
    ) -> tuple[State, Tensor]:
        """The belief of `infer`, and KL(posterior || prior) of its latent in nats, (rows,)."""
        deter = self._find_deter(state, action, is_first)
        posterior = self._dynamics.posterior(deter, self._encoder(frames))
        return State(deter, posterior.mean), kl_divergence(posterior, self._dynamics.prior(deter))

    def act(self, state: State) -> tuple[Tensor, Tensor]:
        """Mean in [-1, 1] and std of the actor's action at a belief, (rows, action) each."""
        mean, std = self._actor(state.features)
        return mean, std

    def surprise(self, state: State) -> Tensor:
        """The surprise of beliefs in nats, (rows,); see `WorldModel.surprise`."""
        return surprise(state.stoch, self._dynamics.prior(state.deter))

    def _find_deter(self, state: State, action: Tensor | None, is_first: Tensor | None) -> Tensor:
        """The deterministic state (rows, deter) at the frames; see `infer`."""
        deter = state.deter if action is None else self._advance(state, action)
        return deter if is_first is None else torch.where(is_first[:, None], 0.0, deter)

    def _advance(self, state: State, action: Tensor) -> Tensor:
        """The deterministic state (rows, deter) after actions (rows, action)."""
        return self._dynamics.advance(state, action)


class Backend:
    """Computes a world model in plain torch.

    Methods that read weights take the model as their first argument, so that copies of a model can share a backend. A
    backend can be copied and pickled with its model.

    Args:
        trunk_dtype: Precision of the matrix products outside the last layers of heads.
    """

    def __init__(self, trunk_dtype: torch.dtype = torch.float32) -> None:
        self.trunk_dtype = trunk_dtype

    # For planners.

    def step(self, model: WorldModel, state: State, action: Tensor) -> tuple[State, Tensor]:
        """The state after action (rows, action), by the mean of the prior, and the reward (rows,); passes gradients."""
        with model.trunk_precision():
            following = _advance_by_mean(model, state, action)
            return following, model.reward_head.mean(model.reward_head(following.features))

    def fast_step(self, model: WorldModel, state: State, action: Tensor) -> tuple[State, Tensor]:
        """The same as `step`; a faster backend need not pass gradients."""
        return self.step(model, state, action)

    def rollout(self, model: WorldModel, state: State, actions: Tensor) -> tuple[Tensor, State]:
        """Rewards and last state of repeated steps along actions (rows, horizon, action).

        Gradients reach the state and the actions. A faster backend need not pass gradients to the weights.

        Returns:
            Rewards float32 (rows, horizon), and the last state.
        """
        rewards: list[Tensor] = []
        for action in actions.unbind(1):
            state, reward = self.step(model, state, action)
            rewards.append(reward)
        return torch.stack(rewards, 1), state

    def propose(self, model: WorldModel, state: State, noise: Tensor) -> Tensor:
        """Actions of the actor along the mean of the prior, float32 (rows, horizon, action).

        Args:
            model: The world model.
            state: Start of every sequence, (rows, ...).
            noise: Standard normal draws for samples, zeros for the mode, (rows, horizon, action).
        """
        actions: list[Tensor] = []
        for draw in noise.unbind(1):
            with model.trunk_precision():
                if isinstance(model.actor, MixedActor):
                    actions.append(model.actor.sample(state.features, draw))
                else:
                    mean, std = model.actor(state.features)
                    actions.append((mean + std * draw).clamp(-1.0, 1.0))
                state = _advance_by_mean(model, state, actions[-1])
        return torch.stack(actions, 1)

    def value(self, model: WorldModel, state: State) -> Tensor:
        """The expected discounted return from a state on, float32 (...)."""
        with model.trunk_precision():
            return model.value_head.mean(model.value_head(state.features))

    # For agents, which get one frame at a time.

    def frame_functions(self, model: WorldModel) -> FrameFunctions:
        """Belief update and actor with the model's present weights; an agent asks again at every decision."""
        return FrameFunctions(model)

    # For learners, with gradients where weights take part.

    def can_record(self, model: WorldModel) -> bool:
        """Whether a learner can record an update of the model as a CUDA graph, and replay the graph."""
        return model.device.type == "cuda"

    def shift_frames(self, frames: Tensor, offsets: Tensor, pixels: int) -> Tensor:
        """Sequences shifted by whole pixels, with repeated borders.

        On a GPU nothing is read back to the host, as a CUDA graph requires.

        Args:
            frames: (batch, time, height, width, channel).
            offsets: Shift of each sequence down and right, plus `pixels`, in [0, 2 * pixels], (batch, 2).
            pixels: Largest shift.

        Returns:
            Frames of the same shape: row `r` and column `c` hold the old row `r + down` and column `c + right`, with
            `down` and `right` the offsets minus `pixels`.
        """
        height, width = frames.shape[2:4]
        rows = _shifted_places(height, offsets[:, 0], pixels)
        columns = _shifted_places(width, offsets[:, 1], pixels)
        frames = frames.gather(2, rearrange(rows, "batch height -> batch 1 height 1 1").expand(frames.shape))
        return frames.gather(3, rearrange(columns, "batch width -> batch 1 1 width 1").expand(frames.shape))

    def turn_frames(self, frames: Tensor, amounts: Tensor) -> Tensor:
        """Sequences (batch, time, side, side, channel) turned by quarter turns (batch,) in [0, 3].

        On a GPU nothing is read back to the host, as a CUDA graph requires.
        """
        turned = torch.stack([torch.rot90(frames, amount, (2, 3)) for amount in range(4)])
        return turned[amounts, torch.arange(len(frames), device=frames.device)]

    def encode(self, model: WorldModel, frames: Tensor) -> Tensor:
        """Embeddings, float32 (rows, embedding), of uint8 frames (rows, 64, 64, 3); gradients reach the weights."""
        embeddings: Tensor = model.encoder(frames)
        return embeddings

    def reconstruction_errors(self, model: WorldModel, features: Tensor, frames: Tensor) -> Tensor:
        """Squared errors (rows,) of the pictures decoded from features (rows, feature); see `Decoder.loss`."""
        return model.decoder.loss(model.decoder(features), frames)

    def observe(
        self, model: WorldModel, embeddings: Tensor, actions: Tensor, deter: Tensor, noise: Tensor
    ) -> tuple[State, Gaussian]:
        """See `Dynamics.observe`; gradients reach the embeddings and the weights."""
        return model.dynamics.observe(embeddings, actions, deter, noise)

    def predict(self, model: WorldModel, start: State, actions: Tensor) -> tuple[Tensor, Gaussian]:
        """See `Dynamics.predict`; gradients reach the weights."""
        return model.dynamics.predict(start, actions)

    def imagine(
        self, model: WorldModel, start: State, action_noise: Tensor, noise: Tensor, decay: float
    ) -> tuple[Tensor, Tensor]:
        """See `Dynamics.imagine`, with the model's actor as the policy; gradients reach the actor."""
        return model.dynamics.imagine(model.actor, start, action_noise, noise, decay)

    @torch.no_grad()
    def sample(self, model: WorldModel, start: State, action_noise: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Rollouts of a model whose actor is a `MixedActor`, with samples of actor and prior and without gradients.

        Args:
            model: The world model.
            start: Start of every rollout, (rows, ...) each.
            action_noise: Standard normal draws for the actions, (horizon, rows, action).
            noise: Standard normal draws for the latents, (horizon, rows, latent).

        Returns:
            Features, the start first, (horizon + 1, rows, feature), and the actions, (horizon, rows, action).
        """
        assert isinstance(model.actor, MixedActor)
        state, features, actions = start, [start.features], []
        for action_draws, draws in zip(action_noise.unbind(), noise.unbind(), strict=True):
            actions.append(model.actor.sample(features[-1], action_draws))
            deter = model.dynamics.advance(state, actions[-1])
            prior = model.dynamics.prior(deter)
            state = State(deter, torch.addcmul(prior.mean, prior.std, draws))
            features.append(state.features)
        return torch.stack(features), torch.stack(actions)

    def apply(self, network: Mlp, features: Tensor) -> Tensor:
        """The outputs of a network, (..., out), for features (..., in); gradients reach features and weights."""
        outputs: Tensor = network(features)
        return outputs

    def mean(self, head: ScalarHead, logits: Tensor) -> Tensor:
        """See `ScalarHead.mean`; gradients reach the logits."""
        return head.mean(logits)

    def cross_entropy(self, head: ScalarHead, logits: Tensor, targets: Tensor) -> Tensor:
        """See `ScalarHead.loss`; gradients reach the logits."""
        return head.loss(logits, targets)

    def lambda_return(self, rewards: Tensor, discounts: Tensor, values: Tensor, lambda_: float) -> Tensor:
        """See the function `lambda_return`; gradients reach rewards, discounts and values."""
        return lambda_return(rewards, discounts, values, lambda_)

    def frozen_dtype(self, model: WorldModel) -> torch.dtype:
        """The precision in which `imagine` reads weights without a gradient fastest."""
        return self.trunk_dtype

    @torch.no_grad()
    def move_towards(self, slow: Sequence[Tensor], fast: Sequence[Tensor], rate: float | Tensor) -> None:
        """Moves each slow tensor towards the fast tensor at its place, by the share `rate` of their distance, in place.

        Args:
            slow: Tensors that are changed, such as averaged weights.
            fast: Tensors of the same shapes.
            rate: Share of the distance, in [0, 1].
        """
        for slow_tensor, fast_tensor in zip(slow, fast, strict=True):
            slow_tensor.lerp_(fast_tensor, rate)


def lambda_return(rewards: Tensor, discounts: Tensor, values: Tensor, lambda_: float) -> Tensor:
    """λ-returns (Sutton and Barto 2018, eq. 12.18, with a discount per step).

    Args:
        rewards: rewards[t] arrives with state t + 1, (time, ...).
        discounts: discounts[t] weighs the return from state t + 1 on, (time, ...); 0 where the episode ended.
        values: values[t] is the value of state t + 1, (time, ...).
        lambda_: Weight in [0, 1] of longer returns: 0 gives one-step targets, 1 the whole return.

    Returns:
        Returns from state t on, (time, ...).
    """
    following, returns = values[-1], []
    steps = zip(rewards.unbind(), discounts.unbind(), values.unbind(), strict=True)
    for reward, discount, value in reversed(list(steps)):
        mixed = (1.0 - lambda_) * value + lambda_ * following
        following = reward + discount * mixed
        returns.append(following)
    return torch.stack(returns[::-1])


def _shifted_places(size: int, offset: Tensor, pixels: int) -> Tensor:
    """The place in [0, size) that each place of a shifted axis comes from, (batch, size)."""
    places = torch.arange(size, device=offset.device) + (offset[:, None] - pixels)
    return places.clamp(0, size - 1)


def _advance_by_mean(model: WorldModel, state: State, action: Tensor) -> State:
    deter = model.dynamics.advance(state, action)
    return State(deter, model.dynamics.prior(deter).mean)
