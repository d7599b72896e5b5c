"""The actor as a pupil of the planner: its own copy of the weights, its optimizer, and its lessons."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from latentplan.config import DistillConfig, derive_seed
from latentplan.models.heads import Actor
from latentplan.training.distillation.labels import Demonstrations
from latentplan.training.learner.losses import imitation_loss


class Student:
    """Learns to act as demonstrated.

    Args:
        actor: Where it begins; stays as it is.
        settings: Of the distillation.
    """

    def __init__(self, actor: Actor, settings: DistillConfig) -> None:
        self.settings = settings
        self.actor = copy.deepcopy(actor).requires_grad_(True)
        self.optimizer = torch.optim.Adam(self.actor.parameters(), lr=settings.learning_rate, eps=1e-6)

    def learn(self, demonstrations: Demonstrations, round_index: int, report: Callable[[int, float], None]) -> float:
        """Descend on the imitation loss over everything demonstrated.

        Args:
            demonstrations: What is learned from, drawn uniformly.
            round_index: From which the random stream derives.
            report: Called after each update with the number of updates done and the loss.

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
            if features.ndim == 3:  # every turn of a belief learns what was planned for all
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
        """What was learned, in the precision of checkpoints: what is judged is then what is kept."""
        return {name: value.detach().half().float() for name, value in self.actor.state_dict().items()}

    def state_dict(self) -> dict[str, Any]:
        """Weights and optimizer."""
        return {"actor": self.actor.state_dict(), "optimizer": self.optimizer.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up what `state_dict` gave."""
        self.actor.load_state_dict(state["actor"])
        self.optimizer.load_state_dict(state["optimizer"])
