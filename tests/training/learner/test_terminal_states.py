"""Terminal states: the losses ignore rows beyond them."""

import pytest
import torch

from latentplan.training.learner.losses import world_model_loss
from latentplan.training.learner.module import is_refreshed

END = 2  # transitions of the first sequence until it ends


@pytest.fixture
def ended(batch):
    continues = torch.ones_like(batch.continues)
    continues[0, END - 1] = 0.0
    return batch._replace(continues=continues)


@pytest.fixture
def disturbed(ended):
    """The batch `ended` with other pictures, actions and rewards beyond the end."""
    frames, actions, rewards = ended.frames.clone(), ended.actions.clone(), ended.rewards.clone()
    frames[0, END + 1 :] //= 2
    actions[0, END:] *= -1.0
    rewards[0, END:] = 5.0
    return ended._replace(frames=frames, actions=actions, rewards=rewards)


def make_generator():
    return torch.Generator().manual_seed(0)


def test_world_model_loss_ignores_rows_beyond_an_end(model, ended, disturbed, tiny):
    config = tiny("", learning={"overshooting_scale": 1.0, "overshooting_horizon": 2, "free_nats": 0.0}).learning
    one, other = (world_model_loss(model, batch, config, make_generator()).parts for batch in (ended, disturbed))
    for name, part in one.items():
        assert part.item() == pytest.approx(other[name].item(), rel=1e-5), name


def test_behaviour_loss_ignores_rows_beyond_an_end(learner, ended, disturbed):
    losses = []
    for batch in (ended, disturbed):
        learned = world_model_loss(learner.model, batch, learner.config, make_generator())
        learner.return_range.zero_()
        losses.append(learner._behaviour_loss(learned, batch, make_generator())[0].item())
    assert losses[0] == pytest.approx(losses[1], rel=1e-5)


def test_is_refreshed_excludes_rows_beyond_an_end(ended):
    kept = is_refreshed(ended, torch.tensor([True, True, False, True]))
    assert kept[0].tolist() == [True] * (END + 1) + [False] * (5 - END)
    assert kept[1].all() and not kept[2].any()


def test_behaviour_loss_is_finite_when_every_row_ends_an_episode(learner, batch):
    ends = batch._replace(continues=torch.zeros_like(batch.continues))
    learned = world_model_loss(learner.model, ends, learner.config, make_generator())
    loss, parts = learner._behaviour_loss(learned, ends, make_generator())
    assert torch.isfinite(loss) and torch.isfinite(parts["imagined_return"])
