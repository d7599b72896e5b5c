"""Runs in environments whose actions are not a Box of one axis."""

import json

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Dict, Discrete

from latentplan import load_agent
from latentplan.envs import wrap_user_env
from latentplan.evaluation import evaluate_agent
from latentplan.training import train
from tests.training.dot import Dot


class Buttons(Dot):
    """A dot that one of three buttons pushes to the left, not at all, or to the right; a slider scales the push."""

    action_space = Dict({"button": Discrete(3), "slider": gymnasium.spaces.Box(0.0, 1.0, (1, 1), np.float32)})

    def step(self, action):
        assert self.action_space.contains(action)
        return super().step((int(action["button"]) - 1) * action["slider"][0])


@pytest.fixture(scope="module")
def finished(tiny, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "buttons"
    return train(tiny(folder), Buttons)


def test_mixed_actions_are_learned_and_played(finished):
    info = json.loads((finished.run_dir / "checkpoints" / "last" / "info.json").read_text())
    assert (info["action_dim"], info["spaces"]["choices"]) == (2, [3, 0])
    for mode in ("planner", "actor", "random"):
        played = evaluate_agent(load_agent(finished.run_dir, mode), wrap_user_env(Buttons()), seed=0, episodes=1)
        assert 0.0 <= played["mean_return"] <= 20.0


def test_run_with_mixed_actions_repeats_with_its_seed(finished, tiny, tmp_path):
    again = train(tiny(tmp_path / "again"), Buttons)
    weights = [run.run_dir / "checkpoints" / "last" / "weights.safetensors" for run in (finished, again)]
    assert weights[0].read_bytes() == weights[1].read_bytes()
