"""What is learned: the world model from replay, and behaviour in its imagination."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from latentplan.config import LearningConfig
from latentplan.models import Gaussian, State, WorldModel, kl_divergence
from latentplan.models.heads import MAX_ACTION_STD, MIN_ACTION_STD, Actor, ScalarHead, sample_action
from latentplan.replay import Batch


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


def world_model_loss(
    model: WorldModel, batch: Batch, config: LearningConfig, generator: torch.Generator
) -> tuple[Tensor, State, dict[str, Tensor]]:
    """Reconstruction, reward, continuation and balanced KL over a batch of sequences.

    Returns:
        The loss (a scalar), the posterior states (batch, time + 1, ...), and its parts by name, detached.
    """
    size, frames_per_sequence = batch.frames.shape[:2]
    with model.trunk_precision():
        embeddings = model.encoder(batch.frames.flatten(0, 1)).unflatten(0, (size, frames_per_sequence))
    noise = torch.randn(
        size, frames_per_sequence, model.config.latent_dim, generator=generator, device=batch.frames.device
    )
    states, posterior = model.dynamics.observe(embeddings, batch.actions, batch.deter, noise)
    features = states.features
    with model.trunk_precision():
        prior = model.dynamics.prior(states.deter)
        patches = model.decoder(features.flatten(0, 1))
        reward_logits = model.reward_head(features[:, 1:])
        continue_logits = model.continue_head(features[:, 1:]).squeeze(-1)
    overshooting = overshot_reward = batch.rewards.new_zeros(())
    if config.overshooting_scale > 0.0:
        overshooting, overshot_reward = _overshooting(model, batch, states, posterior, config)
    parts = {
        "reconstruction": model.decoder.loss(patches, batch.frames.flatten(0, 1)).mean(),
        "reward": model.reward_head.loss(reward_logits, batch.rewards).mean(),
        "continue": torch.nn.functional.binary_cross_entropy_with_logits(continue_logits, batch.continues),
        "dynamics": _free_kl(_detached(posterior), prior, config.free_nats),
        "representation": _free_kl(posterior, _detached(prior), config.free_nats),
        "overshooting": overshooting,
        "overshot_reward": overshot_reward,
    }
    scales = {
        "reconstruction": config.reconstruction_scale,
        "reward": config.reward_scale,
        "continue": 1.0,
        "dynamics": config.dynamics_scale,
        "representation": config.representation_scale,
        "overshooting": config.overshooting_scale,
        "overshot_reward": config.overshooting_scale * config.reward_scale,
    }
    loss = torch.stack([scales[name] * part for name, part in parts.items()]).sum()
    return loss, State(*(part.detach() for part in states)), {name: part.detach() for name, part in parts.items()}


def imagine(model: WorldModel, start: State, horizon: int, generator: torch.Generator) -> Imagination:
    """Roll the actor out in the model for `horizon` steps from rows of states, with gradients through the dynamics.

    Every other row follows the mean of the prior instead of a sample, so that the value learns on the states a planner
    asks about. The actor reads its state without a gradient, so that each action is credited along the dynamics alone
    (Hafner et al. 2020, section 3).
    """
    state, features, entropies = start, [start.features], []
    rows, device = len(start.deter), start.deter.device
    is_sampled = (torch.arange(rows, device=device) % 2).unsqueeze(-1)
    for _ in range(horizon):
        mean, std = model.actor(features[-1].detach())
        action = sample_action(mean, std, torch.randn(mean.shape, generator=generator, device=device))
        entropies.append((std.log() + 1.4189385).sum(-1))
        deter = model.dynamics.advance(state, action)
        prior = model.dynamics.prior(deter)
        noise = torch.randn(rows, model.config.latent_dim, generator=generator, device=device)
        state = State(deter, prior.mean + prior.std * noise * is_sampled)
        features.append(state.features)
    stacked = torch.stack(features)
    rewards = model.reward_head.mean(model.reward_head(stacked[1:]))
    continues = torch.sigmoid(model.continue_head(stacked[1:])).squeeze(-1)
    return Imagination(stacked, rewards, continues, torch.stack(entropies))


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
    for time in reversed(range(len(rewards))):
        mixed = (1.0 - lambda_) * values[time] + lambda_ * following
        following = rewards[time] + discounts[time] * mixed
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


def _overshooting(
    model: WorldModel, batch: Batch, states: State, posterior: Gaussian, config: LearningConfig
) -> tuple[Tensor, Tensor]:
    """KL and reward loss of open-loop predictions, which is what a planner looks at (latent overshooting).

    From every `overshooting_horizon`-th posterior the true actions are followed by the mean of the prior, as a planner
    does; each prior on the way is pulled to the posterior that saw the frame (Hafner et al. 2019, section 4).
    """
    horizon = min(config.overshooting_horizon, batch.actions.shape[1])

    def windows(sequence: Tensor) -> Tensor:  # (batch, time, ...) -> (rows, horizon, ...)
        return sequence.unfold(1, horizon, horizon).movedim(-1, 2).flatten(0, 1)

    starts = [
        part[:, :-1].detach()[:, ::horizon][:, : batch.actions.shape[1] // horizon].flatten(0, 1) for part in states
    ]
    state, deters, stochs = State(*starts), [], []
    for action in windows(batch.actions).unbind(1):
        deter = model.dynamics.advance(state, action)
        state = State(deter, model.dynamics.prior(deter).mean)
        deters.append(deter)
        stochs.append(state.stoch)
    deter = torch.stack(deters, 1)
    prior = model.dynamics.prior(deter)
    seen = Gaussian(*(windows(part[:, 1:].detach()) for part in posterior))
    features = State(deter, torch.stack(stochs, 1)).features
    with model.trunk_precision():
        reward_logits = model.reward_head(features)
    reward = model.reward_head.loss(reward_logits, windows(batch.rewards)).mean()
    return _free_kl(seen, prior, config.free_nats), reward


def _free_kl(left: Gaussian, right: Gaussian, free_nats: float) -> Tensor:
    return kl_divergence(left, right).clamp_min(free_nats).mean()


def _detached(gaussian: Gaussian) -> Gaussian:
    return Gaussian(gaussian.mean.detach(), gaussian.std.detach())
