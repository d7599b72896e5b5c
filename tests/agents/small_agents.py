"""A world model and settings small enough for tests of agents."""

import torch

from latentplan.config import Config, ModelConfig, PlannerConfig
from latentplan.models import WorldModel
from latentplan.models.fast import accelerate

SIZES = ModelConfig(deter_dim=16, hidden_dim=16, encoder_channels=(8, 8), decoder_channels=2, num_bins=15)
CONFIG = Config(
    model=SIZES,
    planner=PlannerConfig(horizon=3, num_samples=24, num_elites=6, num_iterations=2, num_policy_samples=4),
)


def make_model():
    """An untrained world model whose predicted rewards and actor's modes differ between states."""
    torch.manual_seed(0)
    model = accelerate(WorldModel(CONFIG.model, action_dim=2))
    with torch.no_grad():
        model.reward_head.mlp.output.weight.normal_(std=0.3)
        model.actor.mlp.output.weight.normal_(std=0.3)
    return model
