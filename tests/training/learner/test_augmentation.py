"""Random shifts and quarter turns, one per sequence."""

import pytest
import torch

from latentplan.models import WorldModel
from latentplan.models.backend import Backend
from latentplan.training.learner.augmentation import quarter_turns, random_shift
from latentplan.training.learner.losses import world_model_loss


def make_frames():
    """Pictures whose pixels hold their own row and column."""
    rows, columns = torch.meshgrid(torch.arange(64), torch.arange(64), indexing="ij")
    picture = torch.stack([rows, columns, torch.zeros_like(rows)], -1).to(torch.uint8)
    return picture.expand(32, 3, 64, 64, 3)


def shift(pixels, seed=0):
    return random_shift(Backend(), make_frames(), pixels, torch.Generator().manual_seed(seed))


def test_random_shift_by_zero_pixels_changes_nothing():
    assert torch.equal(shift(0), make_frames())


@pytest.mark.parametrize("pixels", [1, 4])
def test_random_shift_moves_whole_sequences_and_repeats_borders(pixels):
    seen = set()
    for sequence in shift(pixels):
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


def test_random_shift_repeats_with_its_generator():
    assert torch.equal(shift(4), shift(4))
    assert not torch.equal(shift(4), shift(4, seed=1))


def test_world_model_loss_encodes_shifted_frames_and_decodes_unshifted_ones(batch, tiny):
    config = tiny("", learning={"random_shift": 4})
    model = WorldModel(config.model, 1)
    seen, painted = [], []
    model.encoder.register_forward_pre_hook(lambda _, arguments: seen.append(arguments[0]))
    loss = model.decoder.loss
    model.decoder.loss = lambda patches, frames: painted.append(frames) or loss(patches, frames)
    world_model_loss(model, batch, config.learning, torch.Generator().manual_seed(3))
    moved = random_shift(model.backend, batch.frames, 4, torch.Generator().manual_seed(3))
    assert torch.equal(seen[0], moved.flatten(0, 1)) and not torch.equal(moved, batch.frames)
    assert torch.equal(painted[0], batch.frames.flatten(0, 1))


def turn(batch, share, seed=0):
    return quarter_turns(Backend(), batch, share, torch.Generator().manual_seed(seed))


def test_quarter_turns_turns_whole_sequences_and_zeroes_their_beliefs(batch):
    batch = batch._replace(deter=torch.ones_like(batch.deter))
    seen = set()
    for seed in range(8):
        turned, is_same = turn(batch, 0.5, seed)
        for index, same in enumerate(is_same.tolist()):
            fitting = [
                amount
                for amount in range(4)
                if torch.equal(turned.frames[index], torch.rot90(batch.frames[index], amount, (1, 2)))
            ]
            assert len(fitting) == 1 and (fitting[0] == 0) == same
            assert (turned.deter[index] == float(same)).all()
            seen.add(fitting[0])
        others = turned._replace(frames=batch.frames, deter=batch.deter)
        assert all(torch.equal(one, other) for one, other in zip(others, batch, strict=True))
    assert seen == {0, 1, 2, 3}


def test_quarter_turns_with_share_zero_changes_and_draws_nothing(batch):
    generator = torch.Generator().manual_seed(1)
    turned, unturned = quarter_turns(Backend(), batch, 0.0, generator)
    assert turned is batch and unturned.all()
    assert generator.get_state().equal(torch.Generator().manual_seed(1).get_state())
    assert not turn(batch, 1.0)[1].any()
