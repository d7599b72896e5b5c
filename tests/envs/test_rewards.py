"""RewardCheck warns of large rewards."""

import warnings

import numpy as np
import pytest

from latentplan.envs.rewards import RewardCheck

NONE = np.array([False])


def test_reward_check_warns_once_when_discounted_rewards_leave_the_heads_range():
    check = RewardCheck(1, 0.99)
    with pytest.warns(RuntimeWarning, match="scale the rewards down"):
        for _ in range(300):
            check(np.array([100.0]), NONE)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check(np.array([100.0]), NONE)


def test_reward_check_starts_each_episode_at_zero():
    check = RewardCheck(1, 0.99)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for step in range(1000):
            check(np.array([100.0]), np.array([step % 100 == 0]))
