"""Shared parts of the benchmark tests: the scripts on the import path, short episodes, and an untrained agent."""

import contextlib
import functools
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from latentplan import envs
from latentplan.agents.checkpoint import save_checkpoint
from latentplan.config import Config, EnvConfig, LearningConfig, ModelConfig, PlannerConfig
from latentplan.config.quantities import scales
from latentplan.config.spaces import Spaces
from latentplan.models import WorldModel

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))

EPISODE_SECONDS = 1.0  # 100 control steps of cartpole, instead of 1,000


@pytest.fixture(scope="module", autouse=True)
def _short_episodes():
    from dm_control import suite  # after latentplan.envs, which chooses the OpenGL backend

    with pytest.MonkeyPatch.context() as patch:
        load = suite.load

        @functools.wraps(load)
        def load_short(domain, task, task_kwargs=None, **options):
            return load(domain, task, {**(task_kwargs or {}), "time_limit": EPISODE_SECONDS}, **options)

        patch.setattr(suite, "load", load_short)
        yield


@pytest.fixture(scope="module", autouse=True)
def _shared_environments(_short_episodes):
    """One environment per configuration and module, because a renderer takes half a second to start."""
    shared, make_env = {}, envs.make_env

    def make_shared(config, **options):
        key = (config, *options.items())
        if key not in shared:
            env = shared[key] = make_env(config, **options)
            closing.callback(env.close)
            env.close = lambda: None
        return shared[key]

    with contextlib.ExitStack() as closing, pytest.MonkeyPatch.context() as patch:
        patch.setattr("latentplan.envs.make_env", make_shared)
        yield


@pytest.fixture
def _full_episodes(monkeypatch):
    from dm_control import suite

    monkeypatch.setattr(suite, "load", suite.load.__wrapped__)


@pytest.fixture(scope="session")
def config():
    """Settings of a tiny agent for cartpole, with ten decisions per episode."""
    return Config(
        env=EnvConfig(domain="cartpole", task="swingup", action_repeat=10, render_quality="fastest"),
        model=ModelConfig(
            deter_dim=8, hidden_dim=8, decoder_width=4, encoder_channels=(4, 4), decoder_channels=2, num_bins=5
        ),
        planner=PlannerConfig(
            horizon=3, num_samples=8, num_elites=2, num_policy_samples=2, num_iterations=4, warm_start_iterations=2
        ),
        learning=LearningConfig(batch_size=2, sequence_length=3, imagination_horizon=2, imagination_starts=4),
    )


@pytest.fixture(scope="session")
def save_agent(config):
    """A function that saves an untrained agent, with its spaces and changes of its environment; returns the folder."""

    def save(folder, spaces=None, **changes):
        torch.manual_seed(0)
        model = WorldModel(config.model, 1, scales("cartpole"), spaces=spaces or Spaces())
        info = {"domain": "cartpole", "task": "swingup", "env_frames": 1234, "discount": 0.9, "metrics": {}}
        save_checkpoint(folder, model, replace(config, env=replace(config.env, **changes)), info)
        return folder

    return save


@pytest.fixture(scope="session")
def checkpoint(save_agent, tmp_path_factory):
    """Folder of an untrained agent."""
    return save_agent(tmp_path_factory.mktemp("agent"))
