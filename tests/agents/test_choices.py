"""Agents with discrete actions: plans and actors choose categories, checkpoints and programs keep them."""

import copy
import json

import numpy as np
import pytest
import torch

from latentplan import load_agent
from latentplan.agents.actor import ActorAgent
from latentplan.agents.checkpoint import save_checkpoint
from latentplan.agents.export import export_actor
from latentplan.agents.planning import PlanningAgent
from latentplan.config import UserError
from latentplan.config.spaces import Spaces, category_values
from latentplan.models import WorldModel
from latentplan.training.distillation.run import distill
from tests.agents.small_agents import CONFIG, SIZES

CHOICES = (0, 4)
INFO = {"domain": "user", "task": "x", "env_frames": 1, "discount": 0.9}


@pytest.fixture(scope="module")
def model():
    torch.manual_seed(0)
    model = WorldModel(SIZES, 2, spaces=Spaces(CHOICES)).eval()
    for head in (model.actor, model.reward_head):
        head.mlp.output.weight.data.normal_(std=0.5)
    return model


@pytest.fixture(scope="module")
def checkpoint(model, tmp_path_factory):
    folder = tmp_path_factory.mktemp("agent")
    save_checkpoint(folder, model, CONFIG, INFO)
    return folder


@pytest.fixture(scope="module")
def film():
    return np.random.default_rng(0).integers(0, 256, (12, 64, 64, 3), dtype=np.uint8)


@pytest.mark.parametrize("mode", ["planner", "actor", "gated"])
def test_loaded_agents_choose_categories(mode, checkpoint, film):
    agent = load_agent(checkpoint, mode)
    chosen = np.array([agent.act(frame)[1] for frame in film])
    assert np.isin(chosen.round(4), np.round(category_values(4), 4)).all()


def test_background_agent_chooses_categories(checkpoint, film):
    with load_agent(checkpoint, "background") as agent:
        chosen = np.array([agent.act(frame)[1] for frame in film])
    assert np.isin(chosen.round(4), np.round(category_values(4), 4)).all()


def test_description_names_the_choices_and_refuses_others(checkpoint, tmp_path):
    info = json.loads((checkpoint / "info.json").read_text())
    assert info["spaces"]["choices"] == [0, 4]
    for spaces, message in (({"choices": [0, 5]}, "does not fit"), ({"other": 1}, "does not fit"), (3, "dictionary")):
        (tmp_path / "info.json").write_text(json.dumps(info | {"spaces": spaces}))
        (tmp_path / "weights.safetensors").write_bytes((checkpoint / "weights.safetensors").read_bytes())
        with pytest.raises(UserError, match=message):
            load_agent(tmp_path)


def test_description_of_continuous_agents_is_as_before(tmp_path):
    save_checkpoint(tmp_path, WorldModel(SIZES, 2), CONFIG, INFO)
    assert "spaces" not in json.loads((tmp_path / "info.json").read_text())


def test_exploring_planner_draws_other_categories_with_the_probability_of_its_noise(model, film):
    agent = PlanningAgent(model, CONFIG, 0.9, noise_std=0.4, seed=0)
    action = torch.tensor([[0.0, category_values(4)[1]]]).expand(20_000, 2)
    noise = torch.randn(20_000, 2, generator=torch.Generator().manual_seed(0))
    explored = agent._explore(action, noise)
    category = ((explored[:, 1] + 1.0) * 2.0).floor().clamp(max=3)
    shares = torch.bincount(category.long(), minlength=4) / len(category)
    assert torch.allclose(shares, torch.tensor([0.1, 0.7, 0.1, 0.1]), atol=0.01)
    assert abs(explored[:, 0].std() - 0.4) < 0.02


def test_exploring_actor_samples_its_distribution(model, film):
    agent = ActorAgent(model, CONFIG, explore=True, seed=0)
    actions = agent.act(np.repeat(film[:1], 2000, axis=0))
    assert len(np.unique(actions[:, 1].round(4))) > 1
    assert np.isin(actions[:, 1].round(4), np.round(category_values(4), 4)).all()


def test_exported_program_gives_the_actions_of_the_agent(checkpoint, film, tmp_path):
    program = torch.export.load(export_actor(checkpoint, tmp_path / "actor.pt2")).module()
    agent = load_agent(checkpoint, mode="actor")
    action, deter, stoch = (torch.zeros(1, size) for size in (2, 16, 32))
    for time, frame in enumerate(film):
        is_first = torch.tensor([time == 0])
        action, deter, stoch = program(torch.from_numpy(frame[None]), deter, stoch, action, is_first)
        assert np.allclose(action[0].detach().numpy(), agent.act(frame), atol=1e-4)
        assert not any(part.requires_grad for part in (action, deter, stoch))


def test_agent_and_program_repeat_their_last_action_where_weights_are_nan(model, film, tmp_path):
    agent = ActorAgent(copy.deepcopy(model), CONFIG)
    before = agent.act(film[0])
    with torch.no_grad():
        agent.model.actor.mlp.output.bias[2:].fill_(torch.nan)  # the logits alone
    with pytest.warns(RuntimeWarning, match="agent's action is not finite"):
        assert np.array_equal(agent.act(film[1]), before)
    assert agent.num_replaced_actions == 1
    program = torch.export.load(export_actor(agent, tmp_path / "actor.pt2")).module()
    frame, last = torch.from_numpy(film[1:2]), torch.from_numpy(before)[None]
    action, _, _ = program(frame, torch.zeros(1, 16), torch.zeros(1, 32), last, torch.tensor([False]))
    assert torch.equal(action, last)


def test_distill_refuses_discrete_actions(checkpoint, tmp_path):
    with pytest.raises(UserError, match="only continuous actions are distilled"):
        distill(checkpoint, tmp_path / "out", make_env=lambda: None)
