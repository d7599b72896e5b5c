"""The losses of the world model on replayed sequences, and of behaviour on imagined rollouts.

A loss is one function, registered with the name of its column in metrics.csv and with the setting of `LearningConfig`
that weighs it. A new loss needs only its function here and its setting in `config/learning.py`.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import torch
from einops import rearrange
from torch import Tensor

from latentplan.config import LearningConfig
from latentplan.models import Gaussian, State, WorldModel, kl_divergence
from latentplan.models.heads import HALF_LOG_2_PI_E, MAX_ACTION_STD, MIN_ACTION_STD, Actor, MixedActor, symlog
from latentplan.replay.buffer import Batch
from latentplan.training.learner.augmentation import random_shift
from latentplan.training.learner.registry import BEHAVIOUR_LOSSES, WORLD_MODEL_LOSSES, register, weighted_sum
from latentplan.training.ranks import ALONE, MODEL, Ranks

SMALLEST_ERROR = 0.05  # of a picture: about one of 255 grey levels in each of 3,072 numbers
SMALLEST_VECTOR_ERROR = 1e-5  # in squared symlog units


class Imagination(NamedTuple):
    """Imagined rollouts under the actor.

    Attributes:
        features: Features of the states, the start first, (horizon + 1, rows, feature).
        following: Features of the states but the start, (horizon, rows, feature).
        rewards: rewards[t] arrives with features[t + 1], (horizon, rows).
        continues: Probability that the episode continues after features[t + 1], (horizon, rows).
        entropies: Entropy in nats of the action taken at features[t], (horizon, rows).
        log_probs: Log-probability of the action taken at features[t], (horizon, rows), for actors whose gradient is
            that of REINFORCE; None for actors whose gradient passes through the dynamics.
    """

    features: Tensor
    following: Tensor
    rewards: Tensor
    continues: Tensor
    entropies: Tensor
    log_probs: Tensor | None = None


class Counted(NamedTuple):
    """Which frames or transitions of a batch count in a mean, and how many.

    Attributes:
        mask: 1 for those that count, else 0, (batch, time).
        total: Their number, a scalar; where several processes share the batch, the mean of their numbers, so that the
            mean of the processes' means is the mean over the whole batch.
    """

    mask: Tensor
    total: Tensor

    def mean(self, values: Tensor) -> Tensor:
        """Mean of those values that count, a scalar, of values (batch, time) or (batch time,)."""
        return mean_within(values, self.mask.reshape(values.shape), self.total)


class Prediction(NamedTuple):
    """Predictions of the world model over a batch of sequences; every world-model loss is a function of them.

    Attributes:
        model: The world model.
        batch: The sequences.
        config: Settings of learning.
        features: Features of posterior states, (batch, time + 1, feature).
        posterior: Distribution of the latent given the frame, (batch, time + 1, latent).
        prior: Distribution of the latent before the frame, (batch, time + 1, latent).
        reconstruction_errors: Squared error of each decoded picture, (batch time + 1,).
        reward_logits: Predicted rewards, (batch, time, bin).
        continue_logits: Predicted continuation, (batch, time).
        open_loop: Features predicted from actions alone, (batch, reached, feature); see `_predict_open_loop`.
        open_loop_reward_logits: Rewards predicted from `open_loop`, (batch, reached, bin).
        open_loop_divergence: Mean KL of the open-loop priors to the posteriors, in nats, a scalar.
        seen: Frames up to the end of the episode, (batch, time + 1).
        within: Transitions of the episode, (batch, time).
        reached: Those of them that `open_loop` spans, (batch, reached).
    """

    model: WorldModel
    batch: Batch
    config: LearningConfig
    features: Tensor
    posterior: Gaussian
    prior: Gaussian
    reconstruction_errors: Tensor
    reward_logits: Tensor
    continue_logits: Tensor
    open_loop: Tensor
    open_loop_reward_logits: Tensor
    open_loop_divergence: Tensor
    seen: Counted
    within: Counted
    reached: Counted


class Replayed(NamedTuple):
    """Replayed states with the returns that followed them.

    Attributes:
        features: Features of the states, (rows, batch, feature).
        returns: Lambda-returns from each state on, (rows, batch).
        weights: Weights of the states, with mean 1; 0 beyond the end of an episode, (rows, batch).
    """

    features: Tensor
    returns: Tensor
    weights: Tensor


class Behaviour(NamedTuple):
    """Imagined rollouts and replayed states with their returns; every behaviour loss is a function of them.

    Attributes:
        model: The world model, with the actor and the value head that learn.
        config: Settings of learning.
        imagined: Imagined rollouts.
        returns: Lambda-returns of the imagined states but the last, (horizon, rows).
        reach: Probability that a rollout has not ended before each state but the last, (horizon, rows).
        return_scale: Spread of the returns, by which the actor's loss divides them, a scalar.
        baselines: Values of the imagined states but the last, (horizon, rows), without gradient; None for actors whose
            gradient passes through the dynamics.
        replayed: Replayed states with their returns.
    """

    model: WorldModel
    config: LearningConfig
    imagined: Imagination
    returns: Tensor
    reach: Tensor
    return_scale: Tensor
    replayed: Replayed
    baselines: Tensor | None = None


class Learned(NamedTuple):
    """Results of a pass of the world model over a batch.

    Attributes:
        loss: Loss of the world model, a scalar.
        states: Posterior states, (batch, time + 1, ...), detached.
        open_loop: Features of frames 1 to n, predicted from actions alone, (batch, n, feature), detached.
        parts: The recorded losses by name, detached.
    """

    loss: Tensor
    states: State
    open_loop: Tensor
    parts: dict[str, Tensor]


def world_model_loss(
    model: WorldModel, batch: Batch, config: LearningConfig, generator: torch.Generator, ranks: Ranks = ALONE
) -> Learned:
    """The loss of the world model over a batch of sequences, and its posterior and open-loop states.

    Frames beyond a terminal state (see `Batch.within`) have no weight. With `random_shift` the encoder reads shifted
    frames but the decoder reconstructs the unshifted frames, so that the latent need not hold the shift.

    Args:
        model: The world model.
        batch: The sequences; those of this process, where several share a batch. The mean of their losses is then the
            loss over the whole batch.
        config: Settings of learning.
        generator: Random stream of shifts and latents.
        ranks: The processes that share the batch.
    """
    size, frames_per_sequence = batch.frames.shape[:2]
    counts = ranks.mean(batch.within.sum(0), MODEL)  # (time,)
    moved = random_shift(model.backend, batch.frames, config.random_shift, generator, ranks)
    with model.trunk_precision(cache=False):
        embeddings = model.backend.encode(model, moved.flatten(0, 1)).unflatten(0, (size, frames_per_sequence))
        if model.spaces.vector_dim:
            embeddings = embeddings + model.encoder.read_vectors(model.seen_vectors(batch.labels))
    shape = size * ranks.size, frames_per_sequence, model.config.latent_dim
    noise = ranks.part(torch.randn(shape, generator=generator, device=batch.frames.device))
    states, posterior = model.backend.observe(model, embeddings, batch.actions, batch.deter, noise)
    features = states.features
    overshooting, open_loop = _predict_open_loop(model, batch, states, posterior, config, counts)
    reached = open_loop.shape[1]
    with model.trunk_precision(cache=False):
        prior = model.dynamics.prior(states.deter)
        errors = model.backend.reconstruction_errors(model, features.flatten(0, 1), batch.frames.flatten(0, 1))
        reward_logits = model.backend.apply(model.reward_head.mlp, features[:, 1:])
        open_loop_logits = model.backend.apply(model.reward_head.mlp, open_loop)
        continue_logits = model.backend.apply(model.continue_head, features[:, 1:]).squeeze(-1)
    prediction = Prediction(
        model=model,
        batch=batch,
        config=config,
        features=features,
        posterior=posterior,
        prior=prior,
        reconstruction_errors=errors,
        reward_logits=reward_logits,
        continue_logits=continue_logits,
        open_loop=open_loop,
        open_loop_reward_logits=open_loop_logits,
        open_loop_divergence=overshooting,
        seen=Counted(torch.cat([torch.ones_like(batch.within[:, :1]), batch.within], 1), size + counts.sum()),
        within=Counted(batch.within, counts.sum()),
        reached=Counted(batch.within[:, :reached], counts[:reached].sum()),
    )
    loss, parts = weighted_sum(WORLD_MODEL_LOSSES, prediction, config, partial(ranks.mean, half=MODEL))
    return Learned(loss, State(*(part.detach() for part in states)), open_loop.detach(), parts)


@register(WORLD_MODEL_LOSSES, "reconstruction", "reconstruction_scale", floor=SMALLEST_ERROR)
def _reconstruction(predicted: Prediction) -> Tensor:
    """Squared error of the decoded picture, summed over the picture."""
    return predicted.seen.mean(predicted.reconstruction_errors)


@register(WORLD_MODEL_LOSSES, "reward", "reward_scale")
def _reward(predicted: Prediction) -> Tensor:
    """Cross-entropy of the reward predicted from the posterior state, in nats."""
    model, batch = predicted.model, predicted.batch
    return predicted.within.mean(model.backend.cross_entropy(model.reward_head, predicted.reward_logits, batch.rewards))


@register(WORLD_MODEL_LOSSES, "open_loop_reward", "reward_scale")
def _open_loop_reward(predicted: Prediction) -> Tensor:
    """Cross-entropy of the reward predicted from actions alone, as a planner predicts it, in nats."""
    model, batch, reached = predicted.model, predicted.batch, predicted.open_loop.shape[1]
    rewards = batch.rewards[:, :reached]
    errors = model.backend.cross_entropy(model.reward_head, predicted.open_loop_reward_logits, rewards)
    return predicted.reached.mean(errors)


@register(WORLD_MODEL_LOSSES, "continue")
def _continuation(predicted: Prediction) -> Tensor:
    """Binary cross-entropy of the continuation of the episode, in nats."""
    batch, binary_loss = predicted.batch, torch.nn.functional.binary_cross_entropy_with_logits
    return predicted.within.mean(binary_loss(predicted.continue_logits, batch.continues, reduction="none"))


@register(WORLD_MODEL_LOSSES, "dynamics", "dynamics_scale")
def _dynamics(predicted: Prediction) -> Tensor:
    """KL from posterior to prior above the free nats, which moves only the prior (KL balancing, Hafner et al. 2023)."""
    divergence = _free_kl(_detached(predicted.posterior), predicted.prior, predicted.config.free_nats)
    return predicted.seen.mean(divergence)


@register(WORLD_MODEL_LOSSES, "representation", "representation_scale")
def _representation(predicted: Prediction) -> Tensor:
    """The same KL, which moves only the posterior (KL balancing, Hafner et al. 2023)."""
    divergence = _free_kl(predicted.posterior, _detached(predicted.prior), predicted.config.free_nats)
    return predicted.seen.mean(divergence)


@register(WORLD_MODEL_LOSSES, "overshooting", "overshooting_scale")
def _overshooting(predicted: Prediction) -> Tensor:
    """KL from posteriors to open-loop priors, which moves only the priors (Hafner et al. 2019, section 4)."""
    return predicted.open_loop_divergence


@register(WORLD_MODEL_LOSSES, "probe")
def _probe(predicted: Prediction) -> Tensor:
    """Squared errors of labelled quantities read from posterior and open-loop features, in typical sizes."""
    model, batch, reached = predicted.model, predicted.batch, predicted.open_loop.shape[1]
    if not model.labels:
        return batch.rewards.new_zeros(())
    labels = batch.labels[..., : len(model.labels)]
    errors = predicted.seen.mean(_probe_errors(model, predicted.features, labels))
    open_loop_errors = _probe_errors(model, predicted.open_loop, labels[:, 1 : reached + 1])
    return errors + predicted.reached.mean(open_loop_errors)


@register(WORLD_MODEL_LOSSES, "vectors", "vector_scale", is_recorded=False, floor=SMALLEST_VECTOR_ERROR)
def _vectors(predicted: Prediction) -> Tensor:
    """Squared error of each of the numbers beside the frames, in symlog units, (vector,)."""
    model, batch = predicted.model, predicted.batch
    if not model.spaces.vector_dim:
        return batch.rewards.new_zeros(0)
    with model.trunk_precision(cache=False):
        painted = model.backend.apply(model.vector_head, predicted.features)
    errors = (painted - symlog(model.seen_vectors(batch.labels))).square()
    return torch.stack([predicted.seen.mean(error) for error in errors.unbind(-1)])


@register(BEHAVIOUR_LOSSES, "actor")
def _actor(behaviour: Behaviour) -> Tensor:
    """Negative sum of normalised return and weighted entropy.

    The gradient flows through the dynamics. With discrete actions, which pass none, it is that of REINFORCE with the
    value as the baseline (Williams 1992; for world models Hafner et al. 2021, section 2.3).
    """
    entropies = behaviour.config.entropy_scale * behaviour.imagined.entropies
    if behaviour.imagined.log_probs is not None and behaviour.baselines is not None:
        advantages = (behaviour.returns - behaviour.baselines).detach() / behaviour.return_scale
        return -(behaviour.reach * (behaviour.imagined.log_probs * advantages + entropies)).mean()
    return -(behaviour.reach * (behaviour.returns / behaviour.return_scale + entropies)).mean()


@register(BEHAVIOUR_LOSSES, "value")
def _value(behaviour: Behaviour) -> Tensor:
    """Cross-entropy of the value head to returns of imagined rollouts, in nats."""
    with behaviour.model.trunk_precision(cache=False):
        features = behaviour.imagined.features[:-1]
        return value_loss(behaviour.model, features, behaviour.returns, behaviour.reach)


@register(BEHAVIOUR_LOSSES, "replayed_value", "replay_value_scale", is_recorded=False)
def _replayed_value(behaviour: Behaviour) -> Tensor:
    """Cross-entropy of the value head to returns of replayed sequences, in nats."""
    with behaviour.model.trunk_precision(cache=False):
        return value_loss(behaviour.model, *behaviour.replayed)


def imagine(
    model: WorldModel,
    start: State,
    horizon: int,
    generator: torch.Generator,
    decay: float = 1.0,
    ranks: Ranks = ALONE,
) -> Imagination:
    """Imagined rollouts of the actor, with the rewards, continuation and entropies that the losses need.

    Args:
        model: The world model, with the actor that chooses the actions.
        start: States from which the rollouts start, (rows, ...).
        horizon: Model steps.
        generator: Random stream of the actions and latents.
        decay: Share of a state's gradient that a step passes back to the state before.
        ranks: The processes that share the rollouts, which draw alike for all of them.
    """
    action_noise, latent_noise = draw_noise(model, horizon, len(start.deter) * ranks.size, generator)
    draws, log_probs = (ranks.part(action_noise, 1), ranks.part(latent_noise, 1)), None
    if isinstance(model.actor, MixedActor):
        features, actions = model.backend.sample(model, start, *draws)
        log_probs, entropies = model.actor.score(features[:-1], actions)
    else:
        features, std = model.backend.imagine(model, start, *draws, decay)
        entropies = entropy(std)
    backend, following = model.backend, features[1:]  # one slice, so that its gradients are summed before they pass
    rewards = backend.mean(model.reward_head, backend.apply(model.reward_head.mlp, following))
    continues = torch.sigmoid(backend.apply(model.continue_head, following)).squeeze(-1)
    return Imagination(features, following, rewards, continues, entropies, log_probs)


def draw_noise(model: WorldModel, horizon: int, rows: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Standard normal draws for imagined rollouts.

    Returns:
        Noise of the actions, (horizon, rows, action), and of the latents, (horizon, rows, latent).
    """
    sizes = [model.action_dim, model.config.latent_dim]
    draws = torch.randn(horizon, rows, sum(sizes), generator=generator, device=model.device)
    action_noise, latent_noise = draws.split(sizes, -1)
    return action_noise, latent_noise


def entropy(std: Tensor) -> Tensor:
    """Entropy in nats of Gaussian actions, (...), for their std (..., action)."""
    return (std.log() + HALF_LOG_2_PI_E).sum(-1)


def value_loss(model: WorldModel, features: Tensor, returns: Tensor, weights: Tensor) -> Tensor:
    """Weighted cross-entropy of the value head on detached features (..., feature) to returns (...)."""
    logits = model.backend.apply(model.value_head.mlp, features.detach())
    return (weights * model.backend.cross_entropy(model.value_head, logits, returns.detach())).mean()


def imitation_loss(actor: Actor, features: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """KL(planner || actor) in nats, summed over the action, (...).

    This direction of the KL makes the actor cover the planner's actions. The planner's std is clamped into the range of
    the actor's std: a target below that range would push the actor's output to where its gradient vanishes.

    Args:
        actor: The actor that learns; only its own weights get a gradient.
        features: Features of beliefs, (..., feature).
        mean: Mean of the planner's first action, in [-1, 1], (..., action).
        std: Std of the planner's first action, (..., action).
    """
    planned = Gaussian(mean, std.clamp(MIN_ACTION_STD, MAX_ACTION_STD))
    return kl_divergence(planned, Gaussian(*actor(features.detach())))


def _predict_open_loop(
    model: WorldModel, batch: Batch, states: State, posterior: Gaussian, config: LearningConfig, counts: Tensor
) -> tuple[Tensor, Tensor]:
    """Predicts latents from actions alone, as a planner does, and compares them with the posteriors.

    Predictions start from every `overshooting_horizon`-th posterior and apply the true actions, with the mean of the
    prior as the latent. `counts` (time,) is how many sequences have not ended before each transition.

    Returns:
        Mean KL of the priors to the posteriors of the same frames, a scalar, and the features of the predicted states,
        (batch, reached, feature).
    """
    length = batch.actions.shape[1]
    horizon = min(config.overshooting_horizon, length)

    def windows(sequence: Tensor) -> Tensor:  # (batch, time, ...) -> (rows, horizon, ...)
        return sequence.unfold(1, horizon, horizon).movedim(-1, 2).flatten(0, 1)

    starts = [part[:, :-1].detach()[:, ::horizon][:, : length // horizon].flatten(0, 1) for part in states]
    deter, prior = model.backend.predict(model, State(*starts), windows(batch.actions))
    seen = Gaussian(*(windows(part[:, 1:].detach()) for part in posterior))
    reached = counts[: length // horizon * horizon].sum()
    divergence = mean_within(_free_kl(seen, prior, config.free_nats), windows(batch.within), reached)
    features = State(deter, prior.mean).features
    return divergence, rearrange(
        features, "(batch window) time ... -> batch (window time) ...", batch=len(batch.actions)
    )


def mean_within(values: Tensor, within: Tensor, total: Tensor) -> Tensor:
    """Mean of the values where `within` is 1, or 0 if `within` is 0 everywhere; both have the same shape.

    `total` is the sum of `within`, or the mean of the sums of several processes that share the values.
    """
    return (values * within).sum() / total.clamp_min(1.0)


def _probe_errors(model: WorldModel, features: Tensor, labels: Tensor) -> Tensor:
    """Mean squared error of the quantities read from features, in typical sizes, (...); features get no gradient."""
    with model.trunk_precision(cache=False):
        predicted = model.backend.apply(model.probe_head, features.detach())
    return (predicted - labels / model.label_scales).square().mean(-1)


def _free_kl(left: Gaussian, right: Gaussian, free_nats: float) -> Tensor:
    return kl_divergence(left, right).clamp_min(free_nats)


def _detached(gaussian: Gaussian) -> Gaussian:
    return Gaussian(gaussian.mean.detach(), gaussian.std.detach())
