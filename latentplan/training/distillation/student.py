"""The student of a distillation: a copy of the actor that learns from the planner's labels."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any, TypedDict

import torch
from torch import Tensor

from latentplan.config import DistillConfig, derive_seed
from latentplan.models.heads import Actor
from latentplan.training.distillation.labels import Demonstrations
from latentplan.training.learner.losses import imitation_loss
from latentplan.training.learner.optimization import OptimizerState, load_optimizer_state


class StudentState(TypedDict):
    """What the `state_dict` of a student returns."""

    actor: dict[str, Tensor]
    optimizer: OptimizerState


class Student:
    """A copy of an actor with its own optimizer, which learns to act as the planner.

    Args:
        actor: Copied; the original does not change.
        settings: Settings of the distillation.
    """

    def __init__(self, actor: Actor, settings: DistillConfig) -> None:
        self.settings = settings
        self.actor = copy.deepcopy(actor).requires_grad_(True)
        self.optimizer = torch.optim.Adam(self.actor.parameters(), lr=settings.learning_rate, eps=1e-6)

    def learn(self, demonstrations: Demonstrations, round_index: int, report: Callable[[int, float], None]) -> float:
        """Minimise the imitation loss over beliefs drawn uniformly.

        Args:
            demonstrations: Beliefs with the planner's first actions.
            round_index: Number of the round, from which the random stream derives.
            report: Called after each update with the number of updates done and the loss in nats.

        Returns:
            The mean loss over the updates, in nats.

        Raises:
            FloatingPointError: The loss is not finite.
        """
        settings, device, total = self.settings, self.actor.mlp.output.weight.device, 0.0
        generator = torch.Generator().manual_seed(derive_seed(settings.seed, "learn", round_index))
        for update in range(settings.updates):
            rows = torch.randint(len(demonstrations), (settings.batch_size,), generator=generator)
            features = demonstrations.states(rows).features.to(device)
            mean, std = (part.to(device) for part in demonstrations.actions(rows))
            if features.ndim == 3:  # (batch, turn, feature): all turns of a belief share one label
                mean, std = (part[:, None].expand(-1, features.shape[1], -1) for part in (mean, std))
            loss = imitation_loss(self.actor, features, mean, std).mean()
            if not torch.isfinite(loss):
                raise FloatingPointError(f"the imitation loss is not finite at update {update} of round {round_index}")
            self.optimizer.zero_grad(set_to_none=True)
            loss.backward()
            self.optimizer.step()
            total += float(loss.detach())
            report(update + 1, float(loss.detach()))
        return total / settings.updates

    def weights(self) -> dict[str, Tensor]:
        """The weights, rounded to the float16 of checkpoints so that evaluations measure the saved agent."""
        return {name: value.detach().half().float() for name, value in self.actor.state_dict().items()}

    def state_dict(self) -> dict[str, Any]:
        """The states of actor and optimizer."""
        return {"actor": self.actor.state_dict(), "optimizer": self.optimizer.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load what `state_dict` returned.

        Raises:
            RuntimeError: The weights belong to another actor.
            UserError: The state of the optimizer belongs to other parameters.
        """
        self.actor.load_state_dict(state["actor"])
        load_optimizer_state(self.optimizer, state["optimizer"])
