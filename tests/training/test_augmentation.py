"""Random shifts and rotations: one per sequence."""

import pytest
import torch

from latentplan.models import WorldModel
from latentplan.training.augmentation import random_rotation, random_shift, rotate
from latentplan.training.losses import world_model_loss


def _frames() -> torch.Tensor:
    """Pictures whose pixels tell their own row and column."""
    rows, columns = torch.meshgrid(torch.arange(64), torch.arange(64), indexing="ij")
    picture = torch.stack([rows, columns, torch.zeros_like(rows)], -1).to(torch.uint8)
    return picture.expand(32, 3, 64, 64, 3)


def _shifted(pixels: int, seed: int = 0) -> torch.Tensor:
    return random_shift(_frames(), pixels, torch.Generator().manual_seed(seed))


def test_no_pixels_change_nothing() -> None:
    assert torch.equal(_shifted(0), _frames())


@pytest.mark.parametrize("pixels", [1, 4])
def test_every_sequence_moves_as_a_whole_and_repeats_its_border(pixels: int) -> None:
    seen = set()
    for sequence in _shifted(pixels):
        down, right = (int(x) for x in sequence[0, 32, 32, :2].int() - torch.tensor([32, 32]))
        expected = torch.stack(
            [
                (torch.arange(64) + down).clamp(0, 63).unsqueeze(1).expand(64, 64),
                (torch.arange(64) + right).clamp(0, 63).expand(64, 64),
            ],
            -1,
        )
        assert (sequence[..., :2] == expected.to(torch.uint8)).all()
        seen.add((down, right))
    assert max(abs(move) for both in seen for move in both) == pixels
    assert len(seen) > 2 * pixels


def test_the_moves_are_those_of_the_generator() -> None:
    assert torch.equal(_shifted(4), _shifted(4))
    assert not torch.equal(_shifted(4), _shifted(4, seed=1))


def test_the_encoder_sees_moved_frames_and_the_decoder_paints_them_unmoved(batch, tiny) -> None:
    config = tiny("", learning={"random_shift": 4})
    model = WorldModel(config.model, 1)
    seen, painted = [], []
    model.encoder.register_forward_pre_hook(lambda _, arguments: seen.append(arguments[0]))
    loss = model.decoder.loss
    model.decoder.loss = lambda patches, frames: painted.append(frames) or loss(patches, frames)
    world_model_loss(model, batch, config.learning, torch.Generator().manual_seed(3))
    moved = random_shift(batch.frames, 4, torch.Generator().manual_seed(3))
    assert torch.equal(seen[0], moved.flatten(0, 1)) and not torch.equal(moved, batch.frames)
    assert torch.equal(painted[0], batch.frames.flatten(0, 1))


def _dots(size: int) -> torch.Tensor:
    """A dot that wanders outwards over three frames, 8 to 20 pixels right of the middle."""
    frames = torch.zeros(size, 3, 64, 64, 3, dtype=torch.uint8)
    for time, column in enumerate((40, 46, 52)):
        frames[:, time, 30:34, column - 2 : column + 2] = 200
    return frames


def _middles(frames: torch.Tensor) -> torch.Tensor:
    """Where the dots are, from the middle of the picture, (batch, time, 2)."""
    weights = frames[..., 0].double()
    places = torch.arange(64, dtype=torch.double) - 31.5
    down, right = (weights.sum(3) * places).sum(2), (weights.sum(2) * places).sum(2)
    return torch.stack([down, right], -1) / weights.sum((2, 3)).unsqueeze(-1)


def test_a_sequence_turns_as_a_whole_about_the_middle() -> None:
    turned = _middles(random_rotation(_dots(64), torch.Generator().manual_seed(0)))
    radii, angles = turned.norm(dim=-1), torch.atan2(turned[..., 0], turned[..., 1])
    torch.testing.assert_close(radii, _middles(_dots(64)).norm(dim=-1), atol=0.1, rtol=0)
    apart = torch.remainder(angles - angles[:, :1] + torch.pi, 2 * torch.pi) - torch.pi
    assert apart.abs().max() < 0.02
    assert all(((angles[:, 0] // (torch.pi / 4)) == octant).any() for octant in range(-4, 4))


def test_a_rotation_is_no_mirror() -> None:
    """What lies a quarter turn from the dot still does so, in the same direction."""

    def turned(frames: torch.Tensor) -> torch.Tensor:
        return _middles(random_rotation(frames, torch.Generator().manual_seed(5)))

    first, second = turned(_dots(8)), turned(torch.rot90(_dots(8), dims=(2, 3)))
    quarter = torch.stack([-first[..., 1], first[..., 0]], -1)  # anticlockwise in a picture whose rows go down
    torch.testing.assert_close(second, quarter, atol=0.2, rtol=0)


def test_a_share_of_a_batch_is_turned_and_forgets_its_belief(batch) -> None:
    batch = batch._replace(deter=torch.ones(4, 16))
    turned, count = rotate(batch, 0.5, torch.Generator().manual_seed(0))
    assert count == 2
    assert not (turned.frames[:2] == batch.frames[:2]).flatten(1).all(1).any()
    assert torch.equal(turned.frames[2:], batch.frames[2:])
    assert turned.deter.sum(1).tolist() == [0.0, 0.0, 16.0, 16.0]
    assert rotate(batch, 0.0, torch.Generator()) == (batch, 0)
