"""An untrained agent of cartpole, and sessions that it plays in."""

from dataclasses import replace

import pytest
import torch

from latentplan.config import Config, EnvConfig, ModelConfig, PlannerConfig
from latentplan.config.quantities import scales
from latentplan.envs import make_env
from latentplan.models import WorldModel
from latentplan.models.fast import accelerate
from latentplan.view.pictures import GoalPictures
from latentplan.view.session import Session, Settings, Trained

CONFIG = Config(
    env=EnvConfig(domain="cartpole", task="swingup", action_repeat=10, render_quality="fastest"),
    model=ModelConfig(
        deter_dim=8, hidden_dim=8, decoder_width=4, encoder_channels=(4, 4), decoder_channels=2, num_bins=5
    ),
    planner=PlannerConfig(horizon=3, num_samples=16, num_elites=4, num_policy_samples=1, num_iterations=2),
)
PLANNED = [name for name in scales("cartpole") if name != "task.balance"]  # the model does not predict this quantity


@pytest.fixture(scope="session")
def trained():
    torch.manual_seed(0)
    model = WorldModel(CONFIG.model, action_dim=1, labels={name: scales("cartpole")[name] for name in PLANNED})
    with torch.no_grad():
        for head in (model.reward_head, model.actor):
            head.mlp.output.weight.normal_(std=0.5)
    return Trained(accelerate(model), CONFIG, {"discount": 0.9})


@pytest.fixture
def make_session(trained, tmp_path):
    """A function that makes a session; every environment is closed at the end of the test."""
    made = []

    def make(*, seed=0, action_repeat=CONFIG.env.action_repeat, **settings):
        env = make_env(replace(CONFIG.env, action_repeat=action_repeat))
        made.append(env)
        session = Session(env, "cartpole", trained, Settings(**settings), GoalPictures(tmp_path), seed=seed)
        made.append(session)
        return session

    yield make
    for each in reversed(made):
        each.close()


@pytest.fixture
def session(make_session):
    return make_session()
