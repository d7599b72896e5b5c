"""World models of larger pictures and of several cameras."""

import numpy as np
import pytest
import torch

from latentplan.agents.actor import ActorAgent
from latentplan.agents.export import export_actor
from latentplan.config import Config, ModelConfig
from latentplan.config.estimates import count_parameters
from latentplan.config.spaces import FRAME_SIZES, Spaces
from latentplan.models import WorldModel
from latentplan.models.backend import Backend, FrameFunctions
from latentplan.models.fast import accelerate

SIZES = ModelConfig(
    deter_dim=16, hidden_dim=16, decoder_width=8, encoder_channels=(8, 8, 8), decoder_channels=2, num_bins=15
)
SHAPES = [Spaces(frame_size=size, cameras=cameras) for size in FRAME_SIZES for cameras in (1, 2)]


def make_model(spaces):
    torch.manual_seed(0)
    return accelerate(WorldModel(SIZES, 2, spaces=spaces))


def draw_frames(rows, spaces):
    return torch.randint(0, 256, (rows, *spaces.frame_shape), dtype=torch.uint8)


@pytest.mark.parametrize("spaces", SHAPES)
def test_backends_agree_with_plain_torch(spaces):
    model, plain = make_model(spaces), Backend()
    frames, features = draw_frames(4, spaces), torch.randn(4, 48)
    for compute in (
        lambda backend: backend.encode(model, frames),
        lambda backend: backend.reconstruction_errors(model, features, frames),
    ):
        assert torch.allclose(compute(model.backend), compute(plain), rtol=0.05, atol=0.05)
    with torch.no_grad():
        state, action = model.dynamics.initial(4), torch.rand(4, 2)
        ours = model.backend.frame_functions(model).infer(state, action, frames)
        theirs = FrameFunctions(model).infer(state, action, frames)
    assert torch.allclose(ours.features, theirs.features, atol=1e-4)


@pytest.mark.parametrize("spaces", SHAPES)
def test_every_pixel_of_every_camera_is_read_and_painted(spaces):
    model = make_model(spaces)
    frames = torch.full((1, *spaces.frame_shape), 128, dtype=torch.uint8)
    size = spaces.frame_size
    for row, column, channel in ((0, 0, 0), (size - 1, size - 1, spaces.frame_shape[2] - 1)):
        other = frames.clone()
        other[0, row, column, channel] = 0
        features = torch.zeros(1, 48)
        errors = [model.decoder.loss(model.decoder(features), each) for each in (frames, other)]
        assert not torch.equal(*errors)
    assert model.decoder.picture(torch.zeros(1, 48)).shape == (1, size // 2, size // 2, 3)


def test_decoded_picture_is_the_first_cameras():
    model, spaces = make_model(Spaces(cameras=2)), Spaces(cameras=2)
    frames = torch.zeros(1, *spaces.frame_shape, dtype=torch.uint8)
    frames[..., :3] = 200
    features = torch.randn(1, 48)
    optimizer = torch.optim.Adam(model.decoder.parameters(), lr=1e-2)
    for _ in range(200):
        optimizer.zero_grad()
        model.decoder.loss(model.decoder(features), frames).sum().backward()
        optimizer.step()
    assert abs(model.decoder.picture(features).float().mean() - 200.0) < 10.0


@pytest.mark.parametrize("size", FRAME_SIZES)
def test_parameters_are_counted_for_every_size(size):
    model = WorldModel(SIZES, 1, spaces=Spaces(frame_size=size))
    counted = sum(weight.numel() for weight in model.parameters() if weight.dim() > 1)
    assert counted / 1.5 < count_parameters(SIZES, 1, size) < 1.5 * counted


def test_agents_and_exported_programs_take_the_frames_of_their_model(tmp_path):
    spaces = Spaces(frame_size=84, cameras=2)
    model = make_model(spaces)
    agent, frames = ActorAgent(model, Config(model=SIZES)), draw_frames(2, spaces).numpy()
    program = torch.export.load(export_actor(agent, tmp_path / "actor.pt2")).module()
    nothing = (torch.zeros(2, size) for size in (16, 32, 2))
    action, *_ = program(torch.from_numpy(frames), *nothing, torch.ones(2, dtype=torch.bool))
    assert np.allclose(action.detach().numpy(), agent.act(frames), atol=1e-4)
    with pytest.raises(ValueError, match=r"frames must be uint8 \(84, 84, 6\)"):
        agent.act(np.zeros((64, 64, 3), np.uint8))


@pytest.mark.parametrize("wrong", [{"frame_size": 70}, {"frame_size": 64.0}, {"cameras": 0}, {"cameras": 99}])
def test_spaces_refuse_other_frames(wrong):
    with pytest.raises(ValueError, match="must be"):
        Spaces(**wrong)
