"""Rewards given by an objective in place of the task's reward."""

import numpy as np
import pytest

from latentplan.config import Config, EnvConfig, RunConfig, UserError
from latentplan.envs import make_env
from latentplan.evaluation.goals import ScoredEnv, read_goals
from latentplan.training import train

OBJECTIVE = "0.5 * (cart -> 0.5 and upright > 0.9) + 0.1 * abs(pole_speed) + 0.25 * task(balance)"


def config(objective):
    return EnvConfig(domain="cartpole", render_quality="fastest", action_repeat=25, objective=objective)


def returns(env, seed):
    """Returns of a whole episode of random actions."""
    env.reset(seed=seed)
    rng, total, over = np.random.default_rng(seed), 0.0, False
    while not over:
        _, reward, terminated, truncated, _ = env.step(rng.uniform(-1.0, 1.0, 1))
        total += reward
        over = terminated or truncated
    return total


def test_objective_reward_equals_the_score_of_the_evaluation():
    paid, plain = make_env(config(OBJECTIVE)), make_env(config(None))
    scored = ScoredEnv(plain, read_goals(OBJECTIVE, None, "cartpole"))
    earned, task_return = returns(paid, 3), returns(scored, 3)
    assert earned == pytest.approx(scored.scores[0].objective_return, rel=1e-9)
    assert abs(earned - task_return) > 10.0
    paid.close()
    scored.close()


def test_score_of_return_sums_the_objective_reward():
    env = make_env(config("upright > 0.5"))
    scored = ScoredEnv(env, read_goals("return", None, "cartpole"))
    assert scored.scores == [] and returns(scored, 1) == pytest.approx(scored.scores[0].objective_return)
    scored.close()


@pytest.mark.parametrize(
    "objective", ["return", "0.5 * (cart -> 0.5) + return", "goal:x.png", "carts > 0.5", "cart >", ""]
)
def test_make_env_refuses_objectives_that_are_not_functions_of_quantities(objective):
    with pytest.raises(UserError):
        make_env(config(objective))


def test_train_refuses_an_objective_reward_in_a_users_environment(tmp_path):
    settings = Config(env=config("cart > 0"), run=RunConfig(frames=100, run_dir=str(tmp_path / "run")))
    with pytest.raises(UserError, match="returns its own reward"):
        train(settings, make_env=lambda: None)
    assert not (tmp_path / "run").exists()
