"""The agent that acts by the learned actor alone, without planning."""

from __future__ import annotations

import torch
from torch import Tensor

from latentplan.agents.base import ModelAgent
from latentplan.config import Config
from latentplan.models import State, WorldModel
from latentplan.models.encoder import Observation
from latentplan.models.heads import MixedActor, sample_action
from latentplan.models.symmetry import mean_over_turns


class ActorAgent(ModelAgent):
    """Executes the mode of the actor's distribution, or a sample for exploration.

    Args:
        model: The world model.
        config: Settings the model was trained with.
        explore: Whether actions are sampled.
        noise_correlation: Correlation of the sampling noise between one decision and the next, in [0, 1).
        seed: Seed of the agent's own random stream.
    """

    _without_gradients = torch.inference_mode  # takes less time than `torch.no_grad` where torch computes

    def __init__(
        self,
        model: WorldModel,
        config: Config,
        *,
        explore: bool = False,
        noise_correlation: float = 0.0,
        seed: int = 0,
    ) -> None:
        super().__init__(model, config, noise_correlation=noise_correlation, seed=seed)
        self.explore = explore

    def _infer(
        self, state: State, action: Tensor | None, frames: Tensor | Observation, is_first: Tensor | None
    ) -> State:
        belief, self._mean, self._std = self._frame_functions.infer_and_act(state, action, frames, is_first)
        return belief

    def _choose(self, state: State) -> Tensor:
        mean = mean_over_turns(self._mean, state)
        if not self.explore:
            return mean
        if isinstance(self.model.actor, MixedActor):
            noise = self.noise.draw(mean, self.generator, self._is_reset)
            return self.model.actor.sample(state.features, noise)
        std = mean_over_turns(self._std, state)
        return sample_action(mean, std, self.noise.draw(mean, self.generator, self._is_reset))
