"""The backend's path from one frame to an action."""

import numpy as np
import pytest
import torch

from latentplan.agents.actor import ActorAgent
from latentplan.config import Config, ModelConfig
from latentplan.models import State, WorldModel
from latentplan.models.fast import CpuBackend
from latentplan.models.fast.backends import ConvertedWeights


def make_model(channels=(8, 12, 16), seed=0):
    torch.manual_seed(seed)
    config = ModelConfig(deter_dim=24, hidden_dim=20, encoder_channels=channels, decoder_channels=2, num_bins=15)
    model = WorldModel(config, action_dim=3).eval()
    with torch.no_grad():
        for parameter in model.parameters():  # norms and shifts away from ones and zeros
            parameter.add_(0.1 * torch.randn(parameter.shape))
    return model


def frames_of(rows, seed=0):
    return torch.from_numpy(np.random.default_rng(seed).integers(0, 256, (rows, 64, 64, 3), dtype=np.uint8))


@pytest.mark.parametrize("channels", [(8,), (8, 12), (8, 12, 16), (4, 6, 8, 10, 12)])
@pytest.mark.parametrize("rows", [1, 5])
def test_one_frame_path_equals_the_model_for_every_encoder(channels, rows):
    model = make_model(channels)
    advance, see, act = CpuBackend().frame_functions(model)
    state, action = State(torch.randn(rows, 24), torch.randn(rows, 32)), torch.rand(rows, 3) * 2 - 1
    frames = frames_of(rows)
    with torch.no_grad():
        expected = model.infer(state, action, frames)
        believed = see(advance(state, action), frames)
        assert torch.allclose(believed.deter, expected.deter, atol=1e-5)
        assert torch.allclose(believed.stoch, expected.stoch, atol=1e-4)
        for ours, models in zip(act(expected), model.actor(expected.features), strict=True):
            assert torch.allclose(ours, models, atol=1e-5)


def load_other_weights(model):
    model.load_state_dict(make_model(seed=1).state_dict())


def descend(model):
    optimizer = torch.optim.Adam(model.parameters(), lr=0.1, fused=True)
    state = model.see(torch.zeros(2, 24), frames_of(2))
    sum(part.sum() for part in model.actor(state.features)).backward()
    optimizer.step()


@pytest.mark.parametrize("change", [load_other_weights, descend])
def test_agent_uses_weights_that_changed_between_two_frames(change):
    model = make_model()
    model.backend = CpuBackend()
    agent, frames = ActorAgent(model, Config()), frames_of(2)
    action = torch.from_numpy(agent.act(frames.numpy()))
    before = agent.state
    change(model)
    after = agent.act(frames.numpy())
    with torch.no_grad():
        expected = model.infer(before, action, frames)
        assert torch.allclose(agent.state.stoch, expected.stoch, atol=1e-4)
        assert np.allclose(after, model.actor(expected.features)[0].numpy(), atol=1e-4)


def test_backend_changes_no_weight():
    model, same = make_model(), make_model()
    CpuBackend().frame_functions(model).act(State(torch.zeros(1, 24), torch.zeros(1, 32)))
    assert all(torch.equal(ours, theirs) for ours, theirs in zip(model.parameters(), same.parameters(), strict=True))


def test_agent_checks_the_weights_once_per_decision(monkeypatch):
    model, checks, check = make_model(), [], ConvertedWeights.of
    model.backend = CpuBackend()
    agent, frames = ActorAgent(model, Config()), frames_of(2).numpy()
    agent.act(frames)
    monkeypatch.setattr(ConvertedWeights, "of", lambda *arguments: checks.append(1) or check(*arguments))
    agent.act(frames)
    assert len(checks) == 1
