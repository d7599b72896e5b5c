"""The learner: what one update does, as a LightningModule."""

from __future__ import annotations

import copy
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property

import lightning
import torch
from torch import Tensor, nn

from latentplan.config import LearningConfig, derive_seed
from latentplan.models import State, WorldModel
from latentplan.models.heads import ScalarHead
from latentplan.replay.buffer import Batch, Replay
from latentplan.training.learner.augmentation import quarter_turns
from latentplan.training.learner.losses import (
    Learned,
    imagine,
    lambda_return,
    value_loss,
    world_model_loss,
)
from latentplan.training.learner.optimization import average, descend, follow, keep_freed_memory, return_scale
from latentplan.training.learner.snapshot import Snapshot

MODEL, BEHAVIOUR = 0, 1  # the two halves of an update, of its parameters and of its optimizers


class Learner(lightning.LightningModule):
    """Learns a world model from replay, and an actor and a value in its imagination.

    Behaviour learns in a thread of its own, from a snapshot of the model as it was after its latest update, while the
    model takes the next one; both wait for each other after every update, so results do not depend on timing.
    `catch_up` ends an epoch.

    Who acts, is judged and is kept is `averaged`: what the weights were over the latest updates, on average. From one
    update to the next they jump about what they tend to, since the learning rates stay what they are.

    Args:
        model: What is learned.
        config: Losses and optimizers.
        discount: Per decision.
        replay: Where refreshed beliefs go after each update.
        seed: Of the noise of posterior, prior and actor samples.
    """

    return_range: Tensor
    averaged_updates: Tensor

    def __init__(self, model: WorldModel, config: LearningConfig, discount: float, replay: Replay, seed: int) -> None:
        super().__init__()
        keep_freed_memory()
        self.automatic_optimization = False
        self.model, self.config, self.discount, self.replay, self.seed = model, config, discount, replay, seed
        self.target_value = copy.deepcopy(model.value_head).requires_grad_(False)
        self.averaged = copy.deepcopy(model).requires_grad_(False)
        self.register_buffer("return_range", torch.zeros(()))
        self.register_buffer("averaged_updates", torch.zeros(2))  # of the model, of behaviour
        self.updates = 0
        self.metrics: dict[str, Tensor] = {}
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="behaviour")
        self._waiting: tuple[Learned, Batch, torch.Generator] | None = None

    def configure_optimizers(self) -> list[torch.optim.Optimizer]:
        """One Adam for the world model, one for actor and value."""
        rates = (self.config.model_learning_rate, self.config.behaviour_learning_rate)
        capturable = self.device.type == "cuda"
        return [
            torch.optim.Adam(parameters, lr=rate, eps=1e-6, fused=True, capturable=capturable)
            for parameters, rate in zip(_halves(self.model), rates, strict=True)
        ]

    def training_step(self, batch: Batch, batch_index: int) -> None:
        """One update of the world model from a batch of sequences, and of behaviour from the batch before."""
        behaviour = self._start_behaviour()
        generator = torch.Generator(self.device).manual_seed(derive_seed(self.seed, "update", self.updates))
        try:
            learned, batch, unturned = self._learn_model(batch, generator)
        finally:
            self._finish_behaviour(behaviour)
        self.replay.refresh(batch.rows, learned.states.deter, refreshed(batch, unturned))
        self.snapshot.refresh()
        self._waiting = (learned, batch, generator)
        self.updates += 1
        self.metrics |= learned.parts

    @cached_property
    def snapshot(self) -> Snapshot:
        """Where behaviour dreams; made when the model is where it stays."""
        return Snapshot(self.model)

    def catch_up(self) -> None:
        """Let behaviour learn from what the model has learned from; due before weights are used or saved."""
        self._finish_behaviour(self._start_behaviour())

    def forget_values(self) -> None:
        """Begin the value anew, as a run does: what it has learned are sums of another reward. Due between epochs."""
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
        """End the thread."""
        self._thread.shutdown()

    def _start_behaviour(self) -> Future[dict[str, Tensor]] | None:
        if self._waiting is None:
            return None
        waiting, self._waiting = self._waiting, None
        return self._thread.submit(self._learn_behaviour, *waiting)

    def _finish_behaviour(self, behaviour: Future[dict[str, Tensor]] | None) -> None:
        if behaviour is not None:
            self.metrics |= behaviour.result()

    def _learn_model(self, batch: Batch, generator: torch.Generator) -> tuple[Learned, Batch, Tensor]:
        """What was learned, the batch as it was seen, and which of its sequences were seen as they are, (batch,)."""
        batch, unturned = quarter_turns(batch, self.config.turned_share, generator)
        learned = world_model_loss(self.model, batch, self.config, generator)
        learned.parts["model_grad_norm"] = self._descend(self._optimizers()[MODEL], learned.loss)
        self._average(MODEL)
        return learned._replace(loss=learned.loss.detach()), batch, unturned

    def _learn_behaviour(self, learned: Learned, batch: Batch, generator: torch.Generator) -> dict[str, Tensor]:
        loss, parts = self._behaviour_loss(learned, batch, generator)
        parts["behaviour_grad_norm"] = self._descend(self._optimizers()[BEHAVIOUR], loss)
        self._average(BEHAVIOUR)
        follow(self.target_value.parameters(), self.model.value_head.parameters(), self.config.target_rate)
        return parts

    def _average(self, half: int) -> None:
        running, latest = _halves(self.averaged)[half], _halves(self.model)[half]
        average(running, latest, self.averaged_updates[half], self.config.average_rate)

    def _optimizers(self) -> list[torch.optim.Optimizer]:
        optimizers = self.optimizers(use_pl_optimizer=False)
        assert isinstance(optimizers, list)
        return optimizers

    def _behaviour_loss(
        self, learned: Learned, batch: Batch, generator: torch.Generator
    ) -> tuple[Tensor, dict[str, Tensor]]:
        config, states = self.config, learned.states
        flat = State(states.deter.flatten(0, 1), states.stoch.flatten(0, 1))
        goes_on = torch.cat([torch.ones_like(batch.continues[:, :1]), batch.within * batch.continues], 1).flatten()
        order = torch.rand(len(flat.deter), generator=generator, device=self.device).masked_fill(goes_on == 0.0, 2.0)
        first = torch.arange(min(config.imagination_starts, len(order)), device=self.device)
        chosen = order.argsort()[first % goes_on.sum().long()]  # what has ended has no future to be imagined
        with self.model.trunk_precision(cache=False):
            dream = imagine(
                self.snapshot.model,
                State(flat.deter[chosen], flat.stoch[chosen]),
                config.imagination_horizon,
                generator,
                config.gradient_decay,
            )
            values = self.target_value.mean(self.target_value(dream.features[1:]))
        discounts = self.discount * dream.continues
        returns = lambda_return(dream.rewards, discounts, values, config.lambda_)
        reach = torch.cat([torch.ones_like(discounts[:1]), discounts[:-1]]).cumprod(0).detach()
        scale = return_scale(self.return_range, returns.detach())
        actor = -(reach * (returns / scale + config.entropy_scale * dream.entropies)).mean()
        with self.model.trunk_precision(cache=False):
            imagined = value_loss(self.model.value_head, dream.features[:-1], returns, reach)
            replayed = self._replayed_value_loss(learned, batch)
        parts = {
            "actor": actor.detach(),
            "imitation": batch.rewards.new_zeros(()),
            "value": imagined.detach(),
            "imagined_return": returns[0].detach().mean(),
            "entropy": dream.entropies.detach().mean(),
        }
        loss = actor + imagined + config.replay_value_scale * replayed
        return loss, parts

    def _replayed_value_loss(self, learned: Learned, batch: Batch) -> Tensor:
        """The value against replayed rewards, at what was seen and at what had been predicted of it without looking.

        A planner asks for the value of predicted states: there it must not mistake the prediction's drift for a gain.
        """
        features = learned.states.features.transpose(0, 1)
        predicted = learned.open_loop.transpose(0, 1)
        with torch.no_grad():
            values = self.target_value.mean(self.target_value(features[1:]))
            discounts = self.discount * batch.continues.T
            returns = lambda_return(batch.rewards.T, discounts, values, self.config.lambda_)
        seen = torch.cat([features[:-1], predicted])
        targets = torch.cat([returns, torch.cat([returns, values[-1:]])[1 : len(predicted) + 1]])
        within = batch.within.T
        reached = torch.cat([within, within[-1:] * batch.continues.T[-1:]])[1 : len(predicted) + 1]
        weights = torch.cat([within, reached])
        return value_loss(self.model.value_head, seen, targets, weights / weights.mean())

    def _descend(self, optimizer: torch.optim.Optimizer, loss: Tensor) -> Tensor:
        return descend(optimizer, loss, self.config.max_grad_norm, self.updates)


def refreshed(batch: Batch, chosen: Tensor) -> Tensor:
    """Whose beliefs are new, (batch, time + 1): the frames of chosen sequences (batch,), but for those past an end."""
    return chosen[:, None] & torch.nn.functional.pad(batch.within, (1, 0), value=1.0).bool()


def _halves(model: WorldModel) -> tuple[list[nn.Parameter], list[nn.Parameter]]:
    """The parameters of the world model, and those of actor and value."""
    behaviour = [*model.actor.parameters(), *model.value_head.parameters()]
    chosen = {id(parameter) for parameter in behaviour}
    return [parameter for parameter in model.parameters() if id(parameter) not in chosen], behaviour
