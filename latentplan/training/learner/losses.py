"""What is learned: the world model from replay, and behaviour in its imagination."""

from __future__ import annotations

from typing import NamedTuple

import torch
from einops import rearrange
from torch import Tensor

from latentplan.config import LearningConfig
from latentplan.models import Gaussian, State, WorldModel, kl_divergence
from latentplan.models.heads import MAX_ACTION_STD, MIN_ACTION_STD, Actor, ScalarHead
from latentplan.replay.buffer import Batch
from latentplan.training.learner.augmentation import random_shift

HALF_LOG_2_PI_E = 1.4189385  # entropy of a Gaussian is log std + this, in nats


class Imagination(NamedTuple):
    """Imagined rollouts under the actor.

    Attributes:
        features: Of the states, the start first, (horizon + 1, rows, feature).
        rewards: rewards[t] arrives with features[t + 1], (horizon, rows).
        continues: Probability that the episode goes on at features[t + 1], (horizon, rows).
        entropies: Of the action taken at features[t], in nats, (horizon, rows).
    """

    features: Tensor
    rewards: Tensor
    continues: Tensor
    entropies: Tensor


class Learned(NamedTuple):
    """What a pass over a batch came to.

    Attributes:
        loss: Of the world model, a scalar.
        states: Posterior states, (batch, time + 1, ...), detached.
        open_loop: Features predicted without looking for the frames 1 to n, (batch, n, feature), detached.
        parts: The parts of the loss by name, detached.
    """

    loss: Tensor
    states: State
    open_loop: Tensor
    parts: dict[str, Tensor]


def world_model_loss(model: WorldModel, batch: Batch, config: LearningConfig, generator: torch.Generator) -> Learned:
    """Reconstruction, reward, continuation and balanced KL over a batch of sequences, and open-loop predictions.

    What lies beyond a terminal state (see `Batch.within`) counts for nothing.

    With `random_shift` the encoder sees moved frames while the decoder paints them unmoved, so that the latent need not
    hold by how much.
    """
    size, frames_per_sequence = batch.frames.shape[:2]
    moved = random_shift(batch.frames, config.random_shift, generator)
    with model.trunk_precision(cache=False):
        embeddings = model.encoder(moved.flatten(0, 1)).unflatten(0, (size, frames_per_sequence))
    noise = torch.randn(
        size, frames_per_sequence, model.config.latent_dim, generator=generator, device=batch.frames.device
    )
    states, posterior = model.backend.observe(model, embeddings, batch.actions, batch.deter, noise)
    features = states.features
    overshooting, open_loop = _predict_open_loop(model, batch, states, posterior, config)
    reached = open_loop.shape[1]
    with model.trunk_precision(cache=False):
        prior = model.dynamics.prior(states.deter)
        patches = model.decoder(features.flatten(0, 1))
        reward_logits = model.reward_head(features[:, 1:])
        open_loop_logits = model.reward_head(open_loop)
        continue_logits = model.continue_head(features[:, 1:]).squeeze(-1)
    within = batch.within
    ahead, seen = within[:, :reached], torch.cat([torch.ones_like(within[:, :1]), within], 1)
    probe = batch.rewards.new_zeros(())
    if model.labels:
        probe = mean_within(_probe_errors(model, features, batch.labels), seen)
        probe = probe + mean_within(_probe_errors(model, open_loop, batch.labels[:, 1 : reached + 1]), ahead)
    binary_loss = torch.nn.functional.binary_cross_entropy_with_logits
    parts = {
        "reconstruction": mean_within(model.decoder.loss(patches, batch.frames.flatten(0, 1)), seen.flatten()),
        "reward": mean_within(model.reward_head.loss(reward_logits, batch.rewards), within),
        "open_loop_reward": mean_within(model.reward_head.loss(open_loop_logits, batch.rewards[:, :reached]), ahead),
        "continue": mean_within(binary_loss(continue_logits, batch.continues, reduction="none"), within),
        "dynamics": mean_within(_free_kl(_detached(posterior), prior, config.free_nats), seen),
        "representation": mean_within(_free_kl(posterior, _detached(prior), config.free_nats), seen),
        "overshooting": overshooting,
        "probe": probe,
    }
    scales = {
        "reconstruction": config.reconstruction_scale,
        "reward": config.reward_scale,
        "open_loop_reward": config.reward_scale,
        "continue": 1.0,
        "dynamics": config.dynamics_scale,
        "representation": config.representation_scale,
        "overshooting": config.overshooting_scale,
        "probe": 1.0,
    }
    loss = torch.stack([scales[name] * part for name, part in parts.items()]).sum()
    detached = {name: part.detach() for name, part in parts.items()}
    return Learned(loss, State(*(part.detach() for part in states)), open_loop.detach(), detached)


def imagine(
    model: WorldModel, start: State, horizon: int, generator: torch.Generator, decay: float = 1.0
) -> Imagination:
    """Roll the actor out in the model for `horizon` steps from rows of states; see `Dynamics.imagine`."""
    stacked, std = model.backend.imagine(model, start, *draw_noise(model, horizon, len(start.deter), generator), decay)
    rewards = model.reward_head.mean(model.reward_head(stacked[1:]))
    continues = torch.sigmoid(model.continue_head(stacked[1:])).squeeze(-1)
    return Imagination(stacked, rewards, continues, entropy(std))


def draw_noise(model: WorldModel, horizon: int, rows: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Standard normal, for actions and latents, (horizon, rows, ...) each."""
    sizes = [model.action_dim, model.config.latent_dim]
    draws = torch.randn(horizon, rows, sum(sizes), generator=generator, device=model.device)
    action_noise, noise = draws.split(sizes, -1)
    return action_noise, noise


def entropy(std: Tensor) -> Tensor:
    """Of Gaussian actions with a std (..., action), in nats, (...)."""
    return (std.log() + HALF_LOG_2_PI_E).sum(-1)


def lambda_return(rewards: Tensor, discounts: Tensor, values: Tensor, lambda_: float) -> Tensor:
    """λ-returns (Sutton and Barto 2018, eq. 12.18, with a discount per step).

    Args:
        rewards: rewards[t] arrives with state t + 1, (time, ...).
        discounts: Of state t + 1 on, zero where the episode ended, (time, ...).
        values: Of state t + 1, (time, ...).
        lambda_: 0 gives one-step targets, 1 the whole return.

    Returns:
        The return from state t on, (time, ...).
    """
    following, returns = values[-1], []
    steps = zip(rewards.unbind(), discounts.unbind(), values.unbind(), strict=True)
    for reward, discount, value in reversed(list(steps)):
        mixed = (1.0 - lambda_) * value + lambda_ * following
        following = reward + discount * mixed
        returns.append(following)
    return torch.stack(returns[::-1])


def value_loss(head: ScalarHead, features: Tensor, returns: Tensor, weights: Tensor) -> Tensor:
    """Weighted cross-entropy of a value head on detached features (..., feature) to returns (...)."""
    logits = head(features.detach())
    return (weights * head.loss(logits, returns.detach())).mean()


def imitation_loss(actor: Actor, features: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """KL(planner || actor) in nats, summed over the action: (...).

    This direction makes the actor cover what the planner would do. A std that the actor cannot have becomes the nearest
    that it can: asked for less than its floor, it would push its output out to where the gradient vanishes.

    Args:
        actor: What learns; no gradient reaches further than its own weights.
        features: Of the beliefs, (..., feature).
        mean: Of the planner's first action, in [-1, 1], (..., action).
        std: Of the planner's first action, (..., action).
    """
    planned = Gaussian(mean, std.clamp(MIN_ACTION_STD, MAX_ACTION_STD))
    return kl_divergence(planned, Gaussian(*actor(features.detach())))


def _predict_open_loop(
    model: WorldModel, batch: Batch, states: State, posterior: Gaussian, config: LearningConfig
) -> tuple[Tensor, Tensor]:
    """KL and features of open-loop predictions, which are what a planner looks at (latent overshooting).

    From every `overshooting_horizon`-th posterior the true actions are followed by the mean of the prior, as a planner
    does; each prior on the way is pulled to the posterior that saw the frame (Hafner et al. 2019, section 4).
    """
    length = batch.actions.shape[1]
    horizon = min(config.overshooting_horizon, length)

    def windows(sequence: Tensor) -> Tensor:  # (batch, time, ...) -> (rows, horizon, ...)
        return sequence.unfold(1, horizon, horizon).movedim(-1, 2).flatten(0, 1)

    starts = [part[:, :-1].detach()[:, ::horizon][:, : length // horizon].flatten(0, 1) for part in states]
    deter, prior = model.backend.predict(model, State(*starts), windows(batch.actions))
    seen = Gaussian(*(windows(part[:, 1:].detach()) for part in posterior))
    divergence = mean_within(_free_kl(seen, prior, config.free_nats), windows(batch.within))
    features = State(deter, prior.mean).features
    return divergence, rearrange(
        features, "(batch window) time ... -> batch (window time) ...", batch=len(batch.actions)
    )


def mean_within(values: Tensor, within: Tensor) -> Tensor:
    """The mean of those values that count: within is 1 for these and 0 for others, of the same shape."""
    return (values * within).sum() / within.sum().clamp_min(1.0)


def _probe_errors(model: WorldModel, features: Tensor, labels: Tensor) -> Tensor:
    """Squared errors of what is read off the latent, in typical sizes, (...); the latent learns nothing from them."""
    with model.trunk_precision(cache=False):
        predicted = model.probe(features.detach())
    return ((predicted - labels) / model.label_scales).square().mean(-1)


def _free_kl(left: Gaussian, right: Gaussian, free_nats: float) -> Tensor:
    return kl_divergence(left, right).clamp_min(free_nats)


def _detached(gaussian: Gaussian) -> Gaussian:
    return Gaussian(gaussian.mean.detach(), gaussian.std.detach())
