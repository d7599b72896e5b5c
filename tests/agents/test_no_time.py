"""Decisions without time for a search count as actions of the actor."""

from dataclasses import replace

import numpy as np

from latentplan.agents.gated import GatedAgent
from tests.agents.small_agents import CONFIG, make_model


def test_gated_agent_reports_the_actor_when_a_search_has_no_time():
    hurried = replace(CONFIG.planner, deadline_ms=1e-6)
    agent = GatedAgent(make_model(), CONFIG, 0.9, planning_budget=1.0, planner=hurried)
    for frames in np.random.default_rng(0).integers(0, 256, (3, 2, 64, 64, 3), dtype=np.uint8):
        agent.act(frames)
        assert agent.last_source == ["actor"] * 2
    assert agent.planned_fraction == 1.0  # the share of decisions for which a search was asked
