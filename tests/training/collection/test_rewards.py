"""RewardCheck refuses rewards that are not finite, and warns of large ones."""

import warnings

import numpy as np
import pytest

from latentplan.config import UserError
from latentplan.training.collection.collector import RewardCheck

NONE = np.array([False])


@pytest.mark.parametrize("reward", [np.nan, np.inf, 1e39])
def test_reward_check_refuses_rewards_that_are_not_finite_in_float32(reward):
    with pytest.raises(UserError, match="not finite"):
        RewardCheck(1, 0.9)(np.array([reward]), NONE)


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
