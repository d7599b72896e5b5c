"""Runs in environments whose actions are not a Box of one axis."""

import json

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Dict, Discrete

from latentplan import load_agent
from latentplan.agents.export import export_actor
from latentplan.config import EnvConfig, UserError
from latentplan.config.spaces import Spaces
from latentplan.envs import wrap_user_env
from latentplan.evaluation import evaluate_agent
from latentplan.models import WorldModel
from latentplan.models.heads import symlog
from latentplan.replay.buffer import Batch
from latentplan.training import resume, train
from latentplan.training.distillation.run import distill
from latentplan.training.learner.losses import world_model_loss
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


class Blind(Dot):
    """A dot that no picture shows: its place is a number beside the picture."""

    observation_space = Dict({"camera": Dot.observation_space, "place": gymnasium.spaces.Box(-1.0, 1.0, (1,))})

    def picture(self):
        picture = np.zeros((16, 16, 3), np.uint8)
        picture[: self.steps % 16] = 255  # the picture changes, but does not depend on the place
        return {"camera": picture, "place": np.array([self.place], np.float32)}


@pytest.fixture(scope="module")
def blind(tiny, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "blind"
    env = {"vectors": ("place",), "action_repeat": 1}
    train(tiny(folder, env=env, run={"frames": 60}), Blind)
    return resume(folder, frames=90, make_env=Blind).run_dir


@pytest.mark.parametrize("mode", ["planner", "actor", "gated", "random"])
def test_agents_see_vectors_beside_the_picture(mode, blind):
    agent = load_agent(blind, mode)
    env = wrap_user_env(Blind(), config=EnvConfig(vectors=("place",)))
    assert 0.0 <= evaluate_agent(agent, env, seed=0, episodes=1)["mean_return"] <= 20.0


def test_beliefs_depend_on_the_vectors_and_predict_them(blind):
    agent, frame = load_agent(blind, "actor"), np.zeros((64, 64, 3), np.uint8)
    left, right = (agent.encode((frame, np.array([place], np.float32))) for place in (-1.0, 1.0))
    assert not np.array_equal(left, right)
    assert agent.model.vector_head.output.weight.shape[0] == 1
    batch = agent.encode((np.stack([frame] * 2), np.array([[-1.0], [1.0]], np.float32)))
    assert np.allclose(batch, np.stack([left, right]), atol=1e-5)


@pytest.mark.parametrize("vectors", [np.zeros(3), np.zeros((2, 1)), None])
def test_agents_refuse_other_vectors(vectors, blind):
    agent, frame = load_agent(blind, "actor"), np.zeros((64, 64, 3), np.uint8)
    with pytest.raises(ValueError, match=r"this agent takes act\(\(frame, info"):
        agent.act(frame if vectors is None else (frame, vectors))


def test_what_needs_pictures_alone_is_refused(blind, tmp_path):
    with pytest.raises(UserError, match="pictures alone"):
        export_actor(blind, tmp_path / "actor.pt2")
    with pytest.raises(UserError, match="pictures alone"):
        distill(blind, tmp_path / "out", make_env=Blind)
    model = load_agent(blind, "actor").model
    assert model.spaces.vector_dim == 1


def test_vectors_are_learned(tiny, tmp_path):
    """A model that sees a number beside a black picture learns to tell the number, its sign and its size."""
    torch.manual_seed(0)
    config = tiny(tmp_path)
    model = WorldModel(config.model, 1, spaces=Spaces(vector_dim=1))
    settings = config.learning
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-2)
    places = 2.0 * torch.rand(16, 6, 1) - 1.0
    batch = Batch(
        frames=torch.zeros(16, 6, 64, 64, 3, dtype=torch.uint8),
        deter=torch.zeros(16, config.model.deter_dim),
        actions=torch.zeros(16, 5, 1),
        rewards=torch.zeros(16, 5),
        continues=torch.ones(16, 5),
        labels=places,
        rows=torch.zeros(16, 6, dtype=torch.long),
    )
    for update in range(150):
        learned = world_model_loss(model, batch, settings, torch.Generator().manual_seed(update))
        optimizer.zero_grad()
        learned.loss.backward()
        optimizer.step()
    errors = model.vector_head(learned.states.features) - symlog(places)
    assert errors.std() < 0.15  # the places themselves have 0.4, and their signs alone leave 0.2
