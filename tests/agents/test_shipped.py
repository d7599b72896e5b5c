"""What is shipped works: every agent in `checkpoints/` loads and acts, and is what its description says."""

import hashlib
from pathlib import Path

import numpy as np
import pytest

from latentplan.agents.checkpoint import load_agent, read_info

CHECKPOINTS = Path(__file__).parents[2] / "checkpoints"


@pytest.mark.parametrize("folder", sorted(CHECKPOINTS.iterdir()), ids=lambda folder: folder.name)
def test_a_shipped_agent_acts(folder):
    info = read_info(folder)
    assert folder.name == f"{info['domain']}-{info['task']}"
    weights = (folder / "weights.safetensors").read_bytes()
    assert len(weights) <= 2_500_000 and hashlib.sha256(weights).hexdigest() == info["sha256"]
    for mode in ("planner", "actor"):
        action = load_agent(folder, mode=mode).act(np.zeros((64, 64, 3), np.uint8))
        assert action.shape == (info["action_dim"],) and np.abs(action).max() <= 1.0
