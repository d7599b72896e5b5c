"""What is done for want of time is not called a plan."""

from dataclasses import replace

import numpy as np

from latentplan.agents.gated import GatedAgent
from tests.agents.small_agents import CONFIG, make_model


def test_what_a_gated_agents_policy_does_is_the_actors():
    hurried = replace(CONFIG.planner, deadline_ms=1e-6)
    agent = GatedAgent(make_model(), CONFIG, 0.9, planning_budget=1.0, planner=hurried)
    for frames in np.random.default_rng(0).integers(0, 256, (3, 2, 64, 64, 3), dtype=np.uint8):
        agent.act(frames)
        assert agent.last_source == ["actor"] * 2
    assert agent.planned_fraction == 1.0  # of what was asked for
