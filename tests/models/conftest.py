"""A small untrained world model; the heads that start at zero have random weights."""

from contextlib import contextmanager

import pytest
import torch

from latentplan.config import ModelConfig
from latentplan.models import State, WorldModel

SMALL = ModelConfig(
    deter_dim=24, hidden_dim=20, decoder_width=10, encoder_channels=(8, 8), decoder_channels=4, num_bins=31
)


@pytest.fixture(scope="module")
def model():
    torch.manual_seed(0)
    model = WorldModel(SMALL, action_dim=3)
    with torch.no_grad():
        for head in (model.reward_head, model.value_head):
            head.mlp.output.weight.normal_(std=0.5)
        model.actor.mlp.output.weight.normal_(std=1.0)
    return model.eval()


@pytest.fixture(params=["float64", "bfloat16", "meta"])
def other_defaults(request):
    """A context with another default dtype of torch, or another default device."""

    @contextmanager
    def enter():
        if request.param == "meta":
            with torch.device("meta"):
                yield
            return
        torch.set_default_dtype(getattr(torch, request.param))
        try:
            yield
        finally:
            torch.set_default_dtype(torch.float32)

    return enter


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(1)


@pytest.fixture
def state(generator):
    """Five states."""
    return State(torch.rand(5, 24, generator=generator) * 2 - 1, torch.randn(5, 32, generator=generator))


@pytest.fixture
def frames(generator):
    """Five pictures of noise."""
    return torch.randint(0, 256, (5, 64, 64, 3), dtype=torch.uint8, generator=generator)
