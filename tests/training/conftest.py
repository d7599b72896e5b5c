"""Fixtures: a task that a run learns within seconds (keep a dot in the middle of a picture), and shared runs."""

import os
import shutil
import signal
from dataclasses import replace

import numpy as np
import pytest
import torch

from latentplan.config import (
    CollectionConfig,
    Config,
    EnvConfig,
    EvaluationConfig,
    LearningConfig,
    ModelConfig,
    PlannerConfig,
    RunConfig,
)
from latentplan.models import WorldModel
from latentplan.replay.buffer import Batch, Replay
from latentplan.training import resume, train
from latentplan.training.learner.module import Learner
from latentplan.training.learner.registry import BEHAVIOUR_LOSSES, WORLD_MODEL_LOSSES
from tests.training.dot import Dot

TINY = Config(
    env=EnvConfig(action_repeat=1),
    model=ModelConfig(
        deter_dim=16, hidden_dim=16, decoder_width=8, encoder_channels=(4, 4), decoder_channels=2, num_bins=15
    ),
    planner=PlannerConfig(
        horizon=2, num_samples=8, num_elites=2, num_iterations=1, warm_start_iterations=1, num_policy_samples=2
    ),
    learning=LearningConfig(batch_size=4, sequence_length=5, imagination_horizon=3, imagination_starts=8),
    collection=CollectionConfig(prefill_decisions=45, round_decisions=15, updates_per_decision=0.4, overlap=False),
    evaluation=EvaluationConfig(every_frames=40, episodes=1, final_episodes=2, video=False, report=False),
    run=RunConfig(frames=90, device="cpu", threads=1),
)


@pytest.fixture(scope="session")
def dot():
    """The environment's class, to make or to extend."""
    return Dot


@pytest.fixture(scope="session")
def tiny():
    """Makes the settings of a run in a folder; arguments replace fields, as in `tiny(folder, run={"seed": 1})`."""

    def make(folder, **changes):
        sections = {name: replace(getattr(TINY, name), **fields) for name, fields in changes.items()}
        config = replace(TINY, **sections)
        return replace(config, run=replace(config.run, run_dir=str(folder)))

    return make


@pytest.fixture(scope="session")
def finished(tiny, dot, tmp_path_factory):
    """A finished run of 90 frames."""
    folder = tmp_path_factory.mktemp("runs") / "finished"
    return train(tiny(folder), dot)


@pytest.fixture(scope="session")
def short(tiny, dot, tmp_path_factory):
    """A finished run of 60 frames."""
    folder = tmp_path_factory.mktemp("runs") / "short"
    return train(tiny(folder, run={"frames": 60}), dot)


@pytest.fixture(scope="session")
def extended(short, dot, tmp_path_factory):
    """The run of 60 frames, resumed to 90 frames in another folder."""
    folder = shutil.copytree(short.run_dir, tmp_path_factory.mktemp("runs") / "extended")
    return resume(folder, frames=90, make_env=dot)


class Interrupting:
    """Extends an environment's class so that one step, counted over all its environments, sends SIGINT."""

    def __init__(self, kind, at_step):
        self.steps_left = at_step
        outer = self

        class Interrupted(kind):
            def step(self, action):
                outer.steps_left -= 1
                if outer.steps_left == 0:
                    os.kill(os.getpid(), signal.SIGINT)
                return super().step(action)

        self.make = Interrupted


@pytest.fixture(scope="session")
def interrupting():
    """`interrupting(kind, at_step).make` is a class of environments, of which one interrupts the run."""
    return Interrupting


@pytest.fixture
def batch():
    rng = np.random.default_rng(0)
    return Batch(
        frames=torch.as_tensor(rng.integers(0, 256, (4, 6, 64, 64, 3), dtype=np.uint8)),
        deter=torch.zeros(4, 16),
        actions=torch.as_tensor(rng.uniform(-1, 1, (4, 5, 1)).astype(np.float32)),
        rewards=torch.as_tensor(rng.uniform(-1, 1, (4, 5)).astype(np.float32)),
        continues=torch.ones(4, 5),
        labels=torch.zeros(4, 6, 0),
        rows=torch.arange(24).reshape(4, 6),
    )


@pytest.fixture
def model(tiny):
    """A tiny world model whose heads have random weights in their last layers too."""
    torch.manual_seed(0)
    model = WorldModel(tiny("").model, action_dim=1)
    with torch.no_grad():
        for head in (model.reward_head, model.value_head):
            head.mlp.output.weight.normal_(std=0.3)
        model.continue_head.output.weight.normal_(std=0.3)
    return model


@pytest.fixture
def learner(model, tiny):
    """A learner of the fixture `model`."""
    replay = Replay(24, 1, 16, 1, torch.device("cpu"))
    return Learner(model, tiny("").learning, 0.9, replay, seed=0)


@pytest.fixture
def restored_losses():
    """Removes the losses that a test registers."""
    registries = (WORLD_MODEL_LOSSES, BEHAVIOUR_LOSSES)
    before = [dict(losses) for losses in registries]
    yield
    for losses, entries in zip(registries, before, strict=True):
        losses.clear()
        losses.update(entries)
