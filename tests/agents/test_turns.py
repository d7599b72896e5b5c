"""Agents with four quarter turns of every frame: turning the frame does not change the action."""

import copy
import dataclasses

import numpy as np
import pytest
import torch

from latentplan.agents.actor import ActorAgent
from latentplan.agents.background import BackgroundAgent
from latentplan.agents.checkpoint import load_agent, save_checkpoint
from latentplan.agents.export import export_actor
from latentplan.agents.gated import GatedAgent
from latentplan.agents.planning import PlanningAgent
from latentplan.config import Config, LearningConfig, UserError
from tests.agents import small_agents
from tests.agents.small_agents import make_plain_model

SIZES = dataclasses.replace(small_agents.SIZES, turns=4)
CONFIG = dataclasses.replace(small_agents.CONFIG, model=SIZES, learning=LearningConfig(turned_share=0.5))
INFO = {"domain": "reacher", "task": "easy", "env_frames": 1, "discount": 0.9}
MAKERS = {
    "planner": lambda model: PlanningAgent(model, CONFIG, 0.9),
    "actor": lambda model: ActorAgent(model, CONFIG),
    "gated": lambda model: GatedAgent(model, CONFIG, 0.9),
    "background": lambda model: BackgroundAgent(model, CONFIG, 0.9, worker="thread"),
}


@pytest.fixture(scope="module")
def model():
    return make_plain_model(SIZES, ("reward_head", "value_head", "actor"), {"distance": 0.1})


@pytest.fixture(params=list(MAKERS))
def make(request):
    made = []

    def build(model):
        made.append(MAKERS[request.param](model))
        return made[-1]

    yield build
    for agent in made:
        if isinstance(agent, BackgroundAgent):
            agent.close()


def test_act_returns_one_action_per_frame(make, model, film):
    agent = make(model)
    actions = np.stack([agent.act(frames) for frames in film])
    assert actions.shape == (5, 3, 2) and np.abs(actions).max() <= 1.0 and np.ptp(actions[0], axis=0).min() > 0.0
    assert agent.state.deter.shape == (3, 4, 16) and agent.state.stoch.shape == (3, 4, 32)
    agent.reset()
    assert agent.act(film[0, 0]).shape == (2,)


def without_turns(model):
    """An actor with the same weights and without turns."""
    alone = copy.deepcopy(model)
    alone.config = dataclasses.replace(SIZES, turns=1)
    return ActorAgent(alone, CONFIG)


def turn(frames, quarters):
    return np.ascontiguousarray(np.rot90(frames, quarters, (1, 2)))


def test_actor_gives_the_same_action_when_the_frame_is_turned(model, film):
    agent, turned, plain = ActorAgent(model, CONFIG), ActorAgent(model, CONFIG), without_turns(model)
    for frames in film:
        expected = agent.act(frames)
        assert np.allclose(turned.act(turn(frames, 1)), expected, atol=1e-5)
        assert not np.allclose(plain.act(turn(frames, 1)), plain.act(frames), atol=1e-2)
        plain.reset()


def test_action_is_the_mean_of_the_actions_of_all_turns(model, film):
    sides = [without_turns(model).act(turn(film[0], side)) for side in range(4)]
    assert np.allclose(ActorAgent(model, CONFIG).act(film[0]), np.mean(sides, axis=0), atol=1e-5)


# Gated and background agents are left out, because the environments of a batch share a threshold or a search.
@pytest.mark.parametrize("make", ["planner", "actor"], indirect=True)
def test_act_gives_each_environment_of_a_batch_its_own_action(make, model, film):
    together, alone = make(model), make(model)
    for frames in film:
        assert np.allclose(together.act(frames)[1], alone.act(frames[1]), atol=0.1)


def test_masked_reset_forgets_the_beliefs_of_all_turns(model, film):
    agent, fresh = (ActorAgent(model, CONFIG) for _ in range(2))
    for frames in film[:3]:
        agent.act(frames)
    agent.reset(np.array([False, True, False]))
    assert np.allclose(agent.act(film[3])[1], fresh.act(film[3])[1], atol=1e-5)


def test_planning_agent_plans_for_an_objective_in_all_turns(model, film):
    agent = PlanningAgent(model, CONFIG, 0.9)
    agent.set_objective("distance -> 0.0", "distance < 0.5")
    assert agent.act(film[0]).shape == (3, 2)


def test_agents_pursue_a_learned_goal_in_all_turns(model, film):
    learned = copy.deepcopy(model)
    learned.add_goal_heads(16)
    for agent in (PlanningAgent(learned, CONFIG, 0.9), GatedAgent(learned, CONFIG, 0.9, planning_budget=0.5)):
        agent.set_objective("distance < 0.05")
        assert all(agent.act(frames).shape == (3, 2) for frames in film)


def test_planning_agent_pursues_a_goal_image_in_all_turns(model, film, tmp_path):
    import cv2

    cv2.imwrite(str(tmp_path / "goal.png"), film[0, 0])
    agent = PlanningAgent(model, CONFIG, 0.9)
    agent.set_objective(f"goal:{tmp_path / 'goal.png'}")
    assert agent.act(film[1]).shape == (3, 2) and agent.imagine().shape == (32, 32, 3)


def test_exported_program_turns_its_frames_itself(model, film, tmp_path):
    for parameter in model.parameters():
        parameter.data = parameter.data.half().float()
    save_checkpoint(tmp_path / "agent", model, CONFIG, INFO)
    program = torch.export.load(export_actor(tmp_path / "agent", tmp_path / "actor.pt2")).module()
    agent = load_agent(tmp_path / "agent", mode="actor")
    action, deter, stoch = torch.zeros(3, 2), torch.full((3, 64), 7.0), torch.full((3, 128), 7.0)
    for time, frames in enumerate(film):
        action, deter, stoch = program(torch.from_numpy(frames), deter, stoch, action, torch.full((3,), time == 0))
        assert np.allclose(action.detach().numpy(), agent.act(frames), atol=1e-4)


def test_config_refuses_turns_without_turned_frames_in_training():
    with pytest.raises(UserError, match="turned_share"):
        Config(model=SIZES)
    with pytest.raises(ValueError, match="turns must be 1 or 4"):
        dataclasses.replace(SIZES, turns=2)
