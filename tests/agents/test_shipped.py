"""Every agent in `checkpoints/` matches its description, and earns far more than a random agent."""

import hashlib
from pathlib import Path

import numpy as np
import pytest

from latentplan.agents.checkpoint import load_agent, load_model, read_info
from latentplan.envs import make_env
from latentplan.evaluation.episodes import episode_seed

CHECKPOINTS = Path(__file__).parents[2] / "checkpoints"
# Floors of the return of the first decisions of an evaluation episode, beside measured returns from the same start.
FLOORS = {
    # agent: (episode, decisions, floor)  actor   random agent
    "ball_in_cup-catch": (1, 75, 70),  #    119        0
    "cartpole-balance": (0, 200, 250),  #   400      156
    "cartpole-swingup": (0, 75, 250),  #    462      103
    "cheetah-run": (0, 125, 60),  #         115        4
    "finger-spin": (0, 75, 60),  #          122        0
    "pendulum-swingup": (0, 150, 100),  #   228        0
    "reacher-easy": (0, 50, 100),  #        188        0
    "walker-run": (0, 125, 50),  #           78        9
    "walker-stand": (0, 75, 95),  #         149       39
    "walker-walk": (0, 75, 55),  #          112        7
}
PLANNER_FLOORS = {
    # agent: (decisions, floor)    planner   random agent
    "cartpole-swingup": (60, 200),  #  352       59
    "reacher-easy": (40, 80),  #       147        0
}


def earned(folder, mode, decisions, episode=0):
    """The return of the first decisions from the start of an evaluation episode."""
    agent, env = load_agent(folder, mode), make_env(load_model(folder)[1].env)
    frame, _ = env.reset(seed=episode_seed(0, episode))
    agent.seed(0)
    total = 0.0
    for _ in range(decisions):
        frame, reward, *_ = env.step(agent.act(frame))
        total += reward
    env.close()
    return total


@pytest.mark.parametrize("name", sorted(path.name for path in CHECKPOINTS.iterdir()))
def test_shipped_checkpoint_matches_its_description_and_its_planner_acts(name):
    info = read_info(CHECKPOINTS / name)
    assert name == f"{info['domain']}-{info['task']}"
    weights = (CHECKPOINTS / name / "weights.safetensors").read_bytes()
    assert len(weights) <= 2_500_000 and hashlib.sha256(weights).hexdigest() == info["sha256"]
    action = load_agent(CHECKPOINTS / name).act(np.zeros((64, 64, 3), np.uint8))
    assert action.shape == (info["action_dim"],) and np.abs(action).max() <= 1.0


@pytest.mark.parametrize("name", sorted(path.name for path in CHECKPOINTS.iterdir()))
def test_shipped_actor_earns_more_than_its_floor(name):
    episode, decisions, floor = FLOORS[name]
    assert earned(CHECKPOINTS / name, "actor", decisions, episode) > floor


@pytest.mark.parametrize("name", PLANNER_FLOORS)
def test_shipped_planner_earns_more_than_its_floor(name):
    decisions, floor = PLANNER_FLOORS[name]
    assert earned(CHECKPOINTS / name, "planner", decisions) > floor
