"""Rewards that cannot be learned from are refused, or told of once."""

import warnings

import numpy as np
import pytest

from latentplan.config import UserError
from latentplan.training.collection.rewards import RewardCheck

NONE = np.array([False])


@pytest.mark.parametrize("reward", [np.nan, np.inf, 1e39])
def test_a_reward_that_replay_cannot_hold_is_refused(reward):
    with pytest.raises(UserError, match="not finite"):
        RewardCheck(1, 0.9)(np.array([reward]), NONE)


def test_rewards_that_add_up_to_too_much_are_told_of_once():
    check = RewardCheck(1, 0.99)
    with pytest.warns(RuntimeWarning, match="scale the rewards down"):
        for _ in range(300):
            check(np.array([100.0]), NONE)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check(np.array([100.0]), NONE)


def test_episodes_do_not_add_up():
    check = RewardCheck(1, 0.99)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for step in range(1000):
            check(np.array([100.0]), np.array([step % 100 == 0]))
