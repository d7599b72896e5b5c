"""An untrained agent for ten-decision episodes of cartpole on disk, and helpers that evaluate it."""

import json

import cv2
import pytest
import torch

from latentplan.agents.checkpoint import save_checkpoint
from latentplan.config import Config, EnvConfig, ModelConfig, PlannerConfig
from latentplan.models import WorldModel

CONFIG = Config(
    env=EnvConfig(domain="cartpole", task="swingup", action_repeat=100, render_quality="fastest"),
    model=ModelConfig(
        deter_dim=8, hidden_dim=8, decoder_width=4, encoder_channels=(4, 4), decoder_channels=2, num_bins=5
    ),
    planner=PlannerConfig(horizon=3, num_samples=8, num_elites=2, num_policy_samples=1, num_iterations=2),
)


def run_eval(checkpoint, *flags):
    """The exit code of `latentplan eval` on the CPU."""
    from latentplan.commands.main import main

    return main(["eval", "--checkpoint", str(checkpoint), "--device", "cpu", *map(str, flags)])


def result_of(tmp_path, checkpoint, *flags):
    """The JSON result of `latentplan eval`."""
    assert run_eval(checkpoint, "--json", tmp_path / "result.json", *flags) == 0
    return json.loads((tmp_path / "result.json").read_text())


def count_frames(film):
    """The number of frames of a film, and their width in pixels."""
    capture, count = cv2.VideoCapture(str(film)), 0
    while capture.grab():
        count += 1
    return count, capture.get(cv2.CAP_PROP_FRAME_WIDTH)


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
