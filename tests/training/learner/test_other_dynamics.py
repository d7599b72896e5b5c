"""Dynamics that no fast backend knows train and plan in plain torch."""

import pytest
import torch
from torch import nn

from latentplan.agents.actor import ActorAgent
from latentplan.agents.export import export_actor
from latentplan.agents.planning import PlanningAgent
from latentplan.config import UserError
from latentplan.models import Dynamics, State, WorldModel
from latentplan.models.backend import Backend
from latentplan.models.dynamics import gaussian
from latentplan.models.fast import accelerate
from latentplan.planning import check_model
from tests.training.learner.test_graphed import draw_rows, make_replay
from tests.training.learner.test_module import Standalone


class TanhRecurrence(Dynamics):
    """A recurrence of one layer in place of the GRU."""

    def __init__(self, latent_dim, deter_dim, action_dim, embedding_dim):
        super().__init__()
        self.latent_dim, self.deter_dim = latent_dim, deter_dim
        self.recurrence = nn.Linear(deter_dim + latent_dim + action_dim, deter_dim)
        self.prior_output = nn.Linear(deter_dim, 2 * latent_dim)
        self.posterior_output = nn.Linear(deter_dim + embedding_dim, 2 * latent_dim)

    def advance(self, state, action):
        return torch.tanh(self.recurrence(torch.cat([state.deter, state.stoch, action], -1))).float()

    def prior(self, deter):
        return gaussian(self.prior_output(deter))

    def posterior(self, deter, embedding):
        return gaussian(self.posterior_output(torch.cat([deter, embedding], -1)))


@pytest.fixture
def model(tiny):
    torch.manual_seed(0)
    sizes = tiny("").model
    model = WorldModel(sizes, action_dim=1, labels={"height": 0.5, "task.stand": 0.5})
    model.dynamics = TanhRecurrence(sizes.latent_dim, sizes.deter_dim, 1, sizes.hidden_dim)
    return accelerate(model)


def test_accelerate_keeps_the_reference_for_unknown_dynamics(model):
    assert type(model.backend) is Backend


def test_unknown_dynamics_learn_from_an_update(model, tiny):
    replay, before = make_replay("cpu"), model.dynamics.recurrence.weight.clone()
    learner = Standalone(model, tiny("").learning, 0.9, replay, seed=0)
    learner.training_step(replay.gather(draw_rows(replay, 1)[0]), 0)
    learner.catch_up()
    assert not torch.equal(model.dynamics.recurrence.weight, before)
    assert all(bool(torch.isfinite(value)) for value in learner.metrics.values())


def test_unknown_dynamics_plan_and_act(model, tiny):
    frame = torch.randint(0, 256, (64, 64, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0)).numpy()
    for agent in (PlanningAgent(model, tiny(""), 0.9), ActorAgent(model, tiny(""))):
        first, second = agent.act(frame), agent.act(frame)
        assert first.shape == second.shape == (1,) and max(abs(first), abs(second)) <= 1.0
    check_model(model, State(torch.zeros(2, 16), torch.zeros(2, 32)), 1)


def test_export_refuses_unknown_dynamics(model, tiny, tmp_path):
    with pytest.raises(UserError, match="TanhRecurrence"):
        export_actor(ActorAgent(model, tiny("")), tmp_path / "actor.pt2")
