"""World models and settings that are small enough for tests of agents."""

import torch

from latentplan.config import Config, ModelConfig, PlannerConfig
from latentplan.models import WorldModel
from latentplan.models.fast import accelerate

SIZES = ModelConfig(
    deter_dim=16, hidden_dim=16, decoder_width=8, encoder_channels=(8, 8), decoder_channels=2, num_bins=15
)
CONFIG = Config(
    model=SIZES,
    planner=PlannerConfig(horizon=3, num_samples=24, num_elites=6, num_iterations=2, num_policy_samples=4),
)


def make_model():
    """An untrained world model on the fast path."""
    return accelerate(make_plain_model())


def make_plain_model(sizes=SIZES, heads=("reward_head", "actor"), labels=None):
    """An untrained world model in plain torch; the outputs of the given heads differ between states."""
    torch.manual_seed(0)
    model = WorldModel(sizes, action_dim=2, labels=labels)
    with torch.no_grad():
        for head in heads:
            getattr(model, head).mlp.output.weight.normal_(std=0.3)
    return model
