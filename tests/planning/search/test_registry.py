"""Planners by name: presets, unknown names, and a newly registered planner in a controller and in an agent."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from latentplan.agents.planning import PlanningAgent
from latentplan.config import Config, ModelConfig, PlannerConfig
from latentplan.models import WorldModel
from latentplan.planning import (
    PLANNERS,
    CEMPlanner,
    ModelPredictiveController,
    Plan,
    Planner,
    SearchOptions,
    icem_planner,
    learned_return,
    make_planner,
    mppi_planner,
)

SIZES = {"horizon": 3, "num_samples": 24, "num_elites": 6, "num_iterations": 2}


@dataclass(frozen=True, kw_only=True, eq=False)
class RandomShooting(SearchOptions):
    """Executes the best of uniformly drawn sequences."""

    action_dim: int
    action_low: float = -1.0
    action_high: float = 1.0
    discount: float = 1.0

    def plan(
        self, model, state, previous=None, *, objective=None, constraints=(), generator=None, deadline_ms=None
    ) -> Plan:
        batch = len(torch.utils._pytree.tree_leaves(state)[0])
        drawn = torch.rand(self.num_samples, self.horizon, self.action_dim, generator=generator)
        actions = self.action_low + (self.action_high - self.action_low) * drawn
        best, best_return = actions[:1].expand(batch, -1, -1), torch.full((batch,), -torch.inf)
        for sequence in actions[:, None].expand(-1, batch, -1, -1):
            current, total = state, torch.zeros(batch)
            for step, action in enumerate(sequence.unbind(1)):
                current, reward = model.step(current, action)
                total = total + self.discount**step * reward
            best = torch.where((total > best_return)[:, None, None], sequence, best)
            best_return = torch.maximum(best_return, total)
        none, ones = torch.zeros(batch, dtype=torch.bool), torch.ones(batch, dtype=torch.long)
        info = {"is_fallback": none, "is_policy": none, "num_nonfinite": 0 * ones}
        return Plan(best, best, torch.zeros_like(best), best_return, info, None, ~none, ones)


@pytest.fixture
def shooting(monkeypatch):
    monkeypatch.setitem(PLANNERS, "shooting", RandomShooting)


def make_agent(**settings):
    torch.manual_seed(0)
    config = Config(
        model=ModelConfig(
            deter_dim=24, hidden_dim=32, decoder_width=16, num_bins=11, encoder_channels=(8, 8), decoder_channels=4
        ),
        planner=PlannerConfig(**SIZES | settings),
    )
    return PlanningAgent(WorldModel(config.model, action_dim=2).eval(), config, discount=0.99, seed=0)


FRAME = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)


def test_controller_plans_with_a_registered_planner(shooting, point, seeded):
    planner = make_planner("shooting", action_dim=2, horizon=6, num_samples=200)
    controller = ModelPredictiveController(planner, point, generator=seeded())
    state = torch.tensor([[1.0, -1.0, 0.0, 0.0], [-0.5, 0.5, 0.0, 0.0]])
    for _ in range(15):
        state = point.dynamics(state, controller.act(state))
    assert state[:, :2].abs().max() < 0.3


def test_agent_plans_with_a_registered_planner(shooting):
    agent = make_agent(method="shooting")
    assert isinstance(agent.controller.planner, RandomShooting)
    first, second = agent.act(FRAME), agent.act(FRAME)
    assert first.shape == (2,) and np.isfinite([first, second]).all() and agent.last_source == "plan"


@pytest.mark.parametrize("method", ["icem", "mppi"])
def test_agent_plans_with_a_preset(method):
    agent = make_agent(method=method, warm_start_iterations=2, init_std=0.5, num_policy_samples=4)
    planner = agent.controller.planner
    assert np.isfinite([agent.act(FRAME), agent.act(FRAME)]).all() and agent.last_source == "plan"
    if method == "icem":
        assert (planner.noise_beta, planner.keep_elite_fraction, planner.final) == (2.0, 0.5, "best")
    else:
        assert (planner.temperature, planner.smoothing, planner.adapt_std) == (0.1, 1.0, False)


def test_make_planner_takes_the_presets_value_where_an_option_has_its_default():
    options = PlannerConfig(num_samples=64, noise_beta=1.0, init_std=0.3)
    icem = make_planner("icem", options, action_dim=2, discount=0.9)
    assert (icem.noise_beta, icem.keep_elite_fraction, icem.final) == (1.0, 0.5, "best")
    assert (icem.num_samples, icem.init_std, icem.action_dim, icem.discount) == (64, 0.3, 2, 0.9)
    mppi = make_planner("mppi", options, action_dim=2)
    assert (mppi.num_elites, mppi.num_iterations, mppi.noise_beta) == (64, 1, 1.0)


def test_make_planner_gives_arguments_precedence_over_options_and_presets():
    assert make_planner("icem", PlannerConfig(noise_beta=1.0), action_dim=1, noise_beta=0.0).noise_beta == 0.0
    assert make_planner("cem", action_dim=1).horizon == SearchOptions.horizon
    assert isinstance(make_planner("cem", PlannerConfig(), action_dim=1), CEMPlanner)


def test_mppi_refits_a_warm_start_as_often_as_a_cold_one():
    assert [mppi_planner(action_dim=1, num_iterations=num).num_warm_iterations for num in (1, 4)] == [1, 4]
    assert mppi_planner(action_dim=1, warm_start_iterations=3, num_iterations=4).num_warm_iterations == 3


def test_presets_plan_longer_for_other_objectives_too(point, states, seeded):
    for planner in (icem_planner, mppi_planner):
        made: Planner = planner(action_dim=2, horizon=3, goal_horizon=4, num_samples=24, num_elites=6)
        plan = made.plan(point, states, objective=learned_return(), generator=seeded())
        assert plan.actions.shape == (5, 4, 2)


@pytest.mark.parametrize(
    ("name", "hint"), [("icme", "did you mean 'icem'"), ("ilqr_", "available: cem, cem_gradient, icem, mppi")]
)
def test_make_planner_names_the_nearest_planner_when_the_name_is_unknown(name, hint):
    with pytest.raises(ValueError, match=hint):
        make_planner(name, action_dim=1)
    with pytest.raises(ValueError, match=f"unknown planner {name!r}"):
        make_agent(method=name)
