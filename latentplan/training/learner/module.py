"""The learner: one update of world model and behaviour, as a LightningModule."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import wait as wait_for
from functools import cached_property, partial

import lightning
import torch
from torch import Tensor, nn

from latentplan.config import LearningConfig, derive_seed
from latentplan.models import State, WorldModel
from latentplan.models.heads import Mlp, ScalarHead
from latentplan.replay.buffer import Batch, Replay
from latentplan.training.learner.augmentation import quarter_turns
from latentplan.training.learner.losses import (
    BEHAVIOUR_LOSSES,
    Behaviour,
    Learned,
    Replayed,
    imagine,
    weighted_sum,
    world_model_loss,
)
from latentplan.training.learner.optimization import (
    descend_if_finite,
    keep_freed_memory,
    return_scale,
    update_average,
)
from latentplan.training.learner.skips import Skips
from latentplan.training.ranks import ALONE, BEHAVIOUR, MODEL, Ranks  # indices of parameters, optimizers, averages


class Learner(lightning.LightningModule):
    """Learns a world model from replayed sequences, and an actor and a value head from imagined rollouts.

    Behaviour learns in a second thread from a snapshot of the model after its latest update, while the model makes its
    next update. The two threads wait for each other after every update, so results do not depend on timing. At the end
    of an epoch `catch_up` makes the behaviour update that is still outstanding.

    Agents act, are evaluated and are saved with the weights of `averaged`, a running average over the latest updates:
    under constant learning rates the learned weights themselves keep fluctuating.

    Several processes, the ranks, may share each batch. Each computes the losses of its own sequences and of its share
    of the imagined rollouts, with the random numbers that one process would draw for them; then one message for each
    half of the update averages gradients and losses, before the gradient is clipped. All ranks therefore make the same
    step, that of one process with the whole batch up to rounding, and skip the same steps.

    Args:
        model: The world model with actor and value head.
        config: Settings of losses and optimizers.
        discount: Discount per decision.
        replay: Stores the refreshed beliefs after each update.
        seed: Seed of the noise in posterior, prior and actor samples.
        ranks: The processes that share each batch.

    Attributes:
        averaged: A copy of the model with averaged weights.
        updates: Updates so far.
        metrics: Losses and gradient norms of the latest update, by name.
        skips: Skipped steps of the world model and of behaviour. A step whose loss or gradient is not finite changes
            neither weights nor replay.
    """

    return_range: Tensor
    averaged_updates: Tensor
    skips: Sequence[Skips]

    def __init__(
        self,
        model: WorldModel,
        config: LearningConfig,
        discount: float,
        replay: Replay,
        seed: int,
        ranks: Ranks = ALONE,
    ) -> None:
        super().__init__()
        self.ranks = ranks
        keep_freed_memory()
        self.automatic_optimization = False
        self.model, self.config, self.discount, self.replay, self.seed = model, config, discount, replay, seed
        self.target_value = copy.deepcopy(model.value_head).requires_grad_(False)
        self.averaged = copy.deepcopy(model).requires_grad_(False)
        self.register_buffer("return_range", torch.zeros(()))
        self.register_buffer("averaged_updates", torch.zeros(2))  # of the model, of behaviour
        self.updates = 0
        self.metrics: dict[str, Tensor] = {}
        shape = config.batch_size // ranks.size, config.sequence_length + 1
        halves = nn.ModuleList(Skips(shape).to(model.device) for _ in (MODEL, BEHAVIOUR))
        self.skips = halves  # type: ignore[assignment]
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="behaviour")
        self._waiting: tuple[Learned, Batch, torch.Generator] | None = None

    def configure_optimizers(self) -> list[torch.optim.Optimizer]:
        """One Adam for the world model, and one for actor and value head."""
        rates = (self.config.model_learning_rate, self.config.behaviour_learning_rate)
        capturable = self.model.backend.can_record(self.model)
        return [
            torch.optim.Adam(parameters, lr=rate, eps=1e-6, fused=True, capturable=capturable)
            for parameters, rate in zip(_halves(self.model), rates, strict=True)
        ]

    def training_step(self, batch: Batch, batch_index: int) -> None:
        """Update the world model from a batch of sequences, and behaviour from the batch before."""
        behaviour = self._start_behaviour()
        generator = torch.Generator(self.device).manual_seed(derive_seed(self.seed, "update", self.updates))
        try:
            learned, batch, is_unturned = self._learn_model(batch, generator)
        finally:
            self._finish_behaviour(behaviour)
        is_finite = torch.isfinite(learned.parts["model_grad_norm"])
        self.replay.refresh(batch.rows, learned.states.deter, is_refreshed(batch, is_unturned & is_finite))
        self.snapshot.refresh()
        self._waiting = (learned, batch, generator)
        self.updates += 1
        self.metrics |= learned.parts

    @cached_property
    def snapshot(self) -> Snapshot:
        """The frozen model in which behaviour imagines; made at first use, when the model is on its device."""
        return Snapshot(self.model, self.model.backend.frozen_dtype(self.model))

    def catch_up(self) -> None:
        """Update behaviour from the latest batch of the model; needed before weights are used or saved."""
        self._finish_behaviour(self._start_behaviour())

    def reset_value_head(self) -> None:
        """Give the value head and its copies new weights, because the reward has changed; only between epochs."""
        head, config = self.model.value_head, self.model.config
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(derive_seed(self.seed, "values", self.updates))
            fresh = ScalarHead(config.deter_dim + config.latent_dim, config.hidden_dim, config.num_bins)
        for values in (head, self.target_value, self.averaged.value_head):
            values.load_state_dict(fresh.state_dict())
        self.return_range.zero_()
        for parameter in head.parameters():
            self._optimizers()[BEHAVIOUR].state.pop(parameter, None)

    def teardown(self, stage: str) -> None:
        """End the behaviour thread."""
        self._thread.shutdown()

    def _start_behaviour(self) -> Future[dict[str, Tensor]] | None:
        if self._waiting is None:
            return None
        waiting, self._waiting = self._waiting, None
        behaviour = self._thread.submit(self._learn_behaviour, *waiting)
        if self.ranks.in_turn:
            wait_for([behaviour])
        return behaviour

    def _finish_behaviour(self, behaviour: Future[dict[str, Tensor]] | None) -> None:
        if behaviour is not None:
            self.metrics |= behaviour.result()

    def _learn_model(self, batch: Batch, generator: torch.Generator) -> tuple[Learned, Batch, Tensor]:
        """Update the world model once.

        Returns:
            The results of the pass, the augmented batch, and which of its sequences were not turned, bool (batch,).
        """
        config, ranks = self.config, self.ranks
        batch, is_unturned = quarter_turns(self.model.backend, batch, config.turned_share, generator, ranks)
        learned = world_model_loss(self.model, batch, config, generator, ranks)
        learned.parts["model_grad_norm"] = self._descend(MODEL, learned.loss, learned.parts, batch.rows)
        self._update_average(MODEL)
        return learned._replace(loss=learned.loss.detach()), batch, is_unturned

    def _learn_behaviour(self, learned: Learned, batch: Batch, generator: torch.Generator) -> dict[str, Tensor]:
        loss, parts = self._behaviour_loss(learned, batch, generator)
        parts["behaviour_grad_norm"] = self._descend(BEHAVIOUR, loss, parts, batch.rows)
        self._update_average(BEHAVIOUR)
        target, values = self.target_value.parameters(), self.model.value_head.parameters()
        self.model.backend.move_towards([*target], [*values], self.config.target_rate)
        return parts

    def _update_average(self, half: int) -> None:
        running, latest = _halves(self.averaged)[half], _halves(self.model)[half]
        update_average(self.model.backend, running, latest, self.averaged_updates[half], self.config.average_rate)

    def _optimizers(self) -> list[torch.optim.Optimizer]:
        optimizers = self.optimizers(use_pl_optimizer=False)
        assert isinstance(optimizers, list)
        return optimizers

    def _behaviour_loss(
        self, learned: Learned, batch: Batch, generator: torch.Generator
    ) -> tuple[Tensor, dict[str, Tensor]]:
        config, states, ranks = self.config, learned.states, self.ranks
        flat = State(*(ranks.gather(part.flatten(0, 1), BEHAVIOUR) for part in states))
        continues = torch.cat([torch.ones_like(batch.continues[:, :1]), batch.within * batch.continues], 1).flatten()
        continues = ranks.gather(continues, BEHAVIOUR)
        order = torch.rand(len(flat.deter), generator=generator, device=self.device).masked_fill(continues == 0.0, 2.0)
        first = torch.arange(min(config.imagination_starts, len(order)), device=self.device)
        chosen = ranks.part(order.argsort()[first % continues.sum().long()])  # terminal states start no rollout
        with self.model.trunk_precision(cache=False):
            imagined = imagine(
                self.snapshot.model,
                State(flat.deter[chosen], flat.stoch[chosen]),
                config.imagination_horizon,
                generator,
                config.gradient_decay,
                ranks,
            )
            values = self._target_values(imagined.following)
            baselines = None
            if imagined.log_probs is not None:
                baselines = torch.cat([self._target_values(imagined.features[:1]), values[:-1]]).detach()
        discounts = self.discount * imagined.continues
        returns = self.model.backend.lambda_return(imagined.rewards, discounts, values, config.lambda_)
        reach = torch.cat([torch.ones_like(discounts[:1]), discounts[:-1]]).cumprod(0).detach()
        scale = return_scale(self.return_range, ranks.gather(returns.detach(), BEHAVIOUR, 1))
        with self.model.trunk_precision(cache=False):
            replayed = self._replayed(learned, batch)
        behaviour = Behaviour(self.model, config, imagined, returns, reach, scale, replayed, baselines)
        loss, parts = weighted_sum(BEHAVIOUR_LOSSES, behaviour, config)
        parts["imagined_return"] = returns[0].detach().mean()
        parts["entropy"] = imagined.entropies.detach().mean()
        return loss, parts

    def _target_values(self, features: Tensor) -> Tensor:
        """Values (...) of states with these features (..., feature), by the slow target."""
        logits = self.model.backend.apply(self.target_value.mlp, features)
        return self.model.backend.mean(self.target_value, logits)

    def _replayed(self, learned: Learned, batch: Batch) -> Replayed:
        """Posterior states and open-loop states of a batch, with the returns of its replayed rewards.

        A planner values states that it predicts in open loop. The value of an open-loop state therefore learns the same
        return as that of the posterior state, so that a planner does not take the drift of predictions for a gain.
        """
        features = learned.states.features.transpose(0, 1)
        predicted = learned.open_loop.transpose(0, 1)
        with torch.no_grad():
            values = self._target_values(features[1:])
            discounts = self.discount * batch.continues.T
            returns = self.model.backend.lambda_return(batch.rewards.T, discounts, values, self.config.lambda_)
        seen = torch.cat([features[:-1], predicted])
        targets = torch.cat([returns, torch.cat([returns, values[-1:]])[1 : len(predicted) + 1]])
        within = batch.within.T
        reached = torch.cat([within, within[-1:] * batch.continues.T[-1:]])[1 : len(predicted) + 1]
        weights = torch.cat([within, reached])
        return Replayed(seen, targets, weights / self.ranks.mean(weights.mean(), BEHAVIOUR))

    def _descend(self, half: int, loss: Tensor, parts: dict[str, Tensor], rows: Tensor) -> Tensor:
        """Makes one step of a half, after all ranks have averaged the gradient, the loss and its parts."""
        average = None if self.ranks.size == 1 else partial(self._average, half, parts)
        norm = descend_if_finite(self._optimizers()[half], loss, self.config.max_grad_norm, average)
        self.skips[half].record(norm, rows)
        return norm

    def _average(self, half: int, parts: dict[str, Tensor], tensors: list[Tensor]) -> None:
        self.ranks.average([*tensors, *parts.values()], half)


def is_refreshed(batch: Batch, chosen: Tensor) -> Tensor:
    """Chooses the frames whose stored beliefs are replaced: frames of chosen sequences, up to the end of the episode.

    Args:
        batch: Sequences.
        chosen: Sequences whose beliefs are replaced, bool (batch,).

    Returns:
        Whether each frame's belief is replaced, bool (batch, time + 1).
    """
    return chosen[:, None] & torch.nn.functional.pad(batch.within, (1, 0), value=1.0).bool()


def _halves(model: WorldModel) -> tuple[list[nn.Parameter], list[nn.Parameter]]:
    """The parameters of the world model, and the parameters of actor and value head."""
    behaviour = [*model.actor.parameters(), *model.value_head.parameters()]
    chosen = {id(parameter) for parameter in behaviour}
    return [parameter for parameter in model.parameters() if id(parameter) not in chosen], behaviour


class Snapshot:
    """A copy of a world model with frozen dynamics, reward and continue heads, and the same actor and value head.

    Norms and the last layers of heads stay in float32.

    Args:
        model: The world model to copy.
        dtype: Precision in which the weights of other matrix products are stored. With the model's `trunk_dtype`
            autocast need not convert them at every use.

    Attributes:
        model: The frozen copy.
    """

    def __init__(self, model: WorldModel, dtype: torch.dtype) -> None:
        self.model = copy.copy(model)  # shares every module
        self.model._modules = dict(model._modules)
        self._pairs: list[tuple[Tensor, Tensor]] = []
        for name in ("dynamics", "reward_head", "continue_head"):
            original = getattr(model, name)
            frozen = copy.deepcopy(original).requires_grad_(False)
            outputs = {id(part.output) for part in frozen.modules() if isinstance(part, Mlp)}
            for part in frozen.modules():
                if isinstance(part, nn.Linear) and id(part) not in outputs:
                    part.to(dtype)
            setattr(self.model, name, frozen)
            self._pairs += zip(frozen.parameters(), original.parameters(), strict=True)

    @torch.no_grad()
    def refresh(self) -> None:
        """Copy the present weights of the model."""
        frozen, original = zip(*self._pairs, strict=True)
        torch._foreach_copy_(list(frozen), list(original))
