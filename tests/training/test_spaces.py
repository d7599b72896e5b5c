"""Runs in environments whose actions are not a Box of one axis."""

import json

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Dict, Discrete

from latentplan import load_agent
from latentplan.envs import wrap_user_env
from latentplan.evaluation import evaluate_agent
from latentplan.training import resume, train
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


class TwoViews(Dot):
    """A dot that each of two cameras sees in half of its places."""

    picture_space = Dot.observation_space
    observation_space = Dict({"left": picture_space, "right": picture_space})

    def picture(self):
        whole = super().picture()
        left, right = whole.copy(), whole.copy()
        left[:, 8:], right[:, :8] = 0, 0
        return {"left": left, "right": right}


def test_run_with_two_cameras_and_larger_frames_saves_resumes_and_plays(tiny, tmp_path):
    env = {"frame_size": 84, "action_repeat": 1}
    run = train(tiny(tmp_path / "run", env=env, run={"frames": 60}), TwoViews)
    run = resume(run.run_dir, frames=90, make_env=TwoViews)
    agent = load_agent(run.run_dir, "planner")
    assert agent.model.spaces.frame_shape == (84, 84, 6)
    env = wrap_user_env(TwoViews(), config=agent.config.env)
    assert 0.0 <= evaluate_agent(agent, env, seed=0, episodes=1)["mean_return"] <= 20.0
    assert agent.imagine() is None or agent.imagine().shape == (42, 42, 3)
