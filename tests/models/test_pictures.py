"""Encoder and decoder: uint8 frames outside, float inside."""

import pytest
import torch
from einops import rearrange, reduce

from latentplan.models.decoder import Decoder
from latentplan.models.encoder import Encoder


def shrunk(frames):
    return reduce(frames.float(), "rows (h y) (w x) c -> rows h w c", "mean", y=2, x=2)


@pytest.mark.parametrize("channels", [(4,), (4, 8), (32, 48, 64), (4, 4, 4, 4, 4)])
def test_encoder_returns_float32_embeddings(channels, frames):
    encoder = Encoder(channels, embedding_dim=10)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        embedding = encoder(frames)
    assert embedding.shape == (5, 10) and embedding.dtype == torch.float32


def test_encoder_leaves_frames_unchanged(frames):
    before = frames.clone()
    Encoder((4, 4), 10)(frames)
    assert torch.equal(frames, before)


def test_encoder_reads_every_pixel():
    torch.manual_seed(0)
    encoder = Encoder((8, 8), 10)
    grey = torch.full((1, 64, 64, 3), 128, dtype=torch.uint8)
    for row, column in ((0, 0), (0, 63), (63, 0), (63, 63), (31, 32)):
        spotted = grey.clone()
        spotted[0, row, column] = 255
        assert not torch.equal(encoder(grey), encoder(spotted))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_encoder_first_layer_equals_a_linear_layer_on_scaled_pixels(dtype, frames):
    torch.manual_seed(0)
    encoder = Encoder((8, 8), 10)
    patches = rearrange(frames, "rows (h y) (w x) c -> rows h w (y x c)", y=4, x=4)
    expected = encoder.patches(patches / 255.0 - 0.5)
    with torch.autocast("cpu", dtype=dtype, enabled=dtype != torch.float32):
        projected = encoder._project(patches)
    assert projected.dtype == dtype
    tolerance = 1e-5 if dtype == torch.float32 else 0.02  # the weights are rounded to 8 bits
    assert torch.allclose(projected.float(), expected, atol=tolerance)


def test_decoder_picture_is_uint8_at_half_resolution(model, state):
    picture = model.decoder.picture(state.features)
    assert picture.shape == (5, 32, 32, 3) and picture.dtype == torch.uint8


def test_decoder_loss_is_the_summed_squared_error(frames):
    torch.manual_seed(0)
    decoder = Decoder(7, channels=4)
    patches = decoder(torch.randn(5, 7))
    pixels = rearrange(patches, "rows h w (y x c) -> rows (h y) (w x) c", y=4, x=4)
    expected = (pixels - (shrunk(frames) / 255.0 - 0.5)).square().sum((1, 2, 3))
    assert torch.allclose(decoder.loss(patches, frames), expected, rtol=1e-4)


def test_decoder_loss_is_zero_for_a_perfect_reconstruction(frames):
    decoder = Decoder(7, channels=4)
    perfect = rearrange(shrunk(frames) / 255.0 - 0.5, "rows (h y) (w x) c -> rows h w (y x c)", y=4, x=4)
    decoder.forward = lambda features: perfect
    assert decoder.loss(perfect, frames).max() < 1e-6
    picture = decoder.picture(torch.zeros(5, 7))
    assert (picture.float() - shrunk(frames)).abs().max() <= 0.501  # rounded to whole numbers
