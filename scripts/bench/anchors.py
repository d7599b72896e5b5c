"""Names of several tasks."""

from __future__ import annotations

TASK_GROUPS = {
    "dmc20": (
        "acrobot-swingup",
        "ball_in_cup-catch",
        "cartpole-balance",
        "cartpole-balance_sparse",
        "cartpole-swingup",
        "cartpole-swingup_sparse",
        "cheetah-run",
        "finger-spin",
        "finger-turn_easy",
        "finger-turn_hard",
        "hopper-hop",
        "hopper-stand",
        "pendulum-swingup",
        "quadruped-run",
        "quadruped-walk",
        "reacher-easy",
        "reacher-hard",
        "walker-run",
        "walker-stand",
        "walker-walk",
    ),
    "dev": (
        "walker-walk",
        "cartpole-swingup",
        "cheetah-run",
        "finger-spin",
        "reacher-easy",
        "ball_in_cup-catch",
        "hopper-stand",
    ),
}
"""Names of several tasks: the twenty tasks with published returns, and those with which changes are tried."""
