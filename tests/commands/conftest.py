"""An untrained agent for ten-decision episodes of cartpole, as the commands find it on disk."""

import pytest
import torch

from latentplan.agents.checkpoint import save_checkpoint
from latentplan.config import Config, EnvConfig, ModelConfig, PlannerConfig
from latentplan.models import WorldModel

CONFIG = Config(
    env=EnvConfig(domain="cartpole", task="swingup", action_repeat=100, render_quality="fastest"),
    model=ModelConfig(deter_dim=8, hidden_dim=8, encoder_channels=(4, 4), decoder_channels=2, num_bins=5),
    planner=PlannerConfig(horizon=3, num_samples=8, num_elites=2, num_policy_samples=1, num_iterations=2),
)


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory):
    """A run folder whose best checkpoint is the agent."""
    folder = tmp_path_factory.mktemp("run")
    info = {"domain": "cartpole", "task": "swingup", "env_frames": 1234, "discount": 0.9, "metrics": {}}
    torch.manual_seed(0)
    save_checkpoint(folder / "checkpoints" / "best", WorldModel(CONFIG.model, action_dim=1), CONFIG, info)
    return folder


@pytest.fixture(scope="session")
def checkpoint(run_folder):
    """The folder of the agent's checkpoint."""
    return run_folder / "checkpoints" / "best"


@pytest.fixture
def assert_refused(capsys):
    """Assert that a command line is refused: exit code 2, nothing on stdout, one line on stderr with some words."""
    from latentplan.commands.main import main

    def check(argv, *words):
        assert main([str(word) for word in argv]) == 2
        captured = capsys.readouterr()
        assert captured.out == "" and captured.err.startswith("error: ") and captured.err.count("\n") == 1
        assert all(str(word) in captured.err for word in words), captured.err

    return check
