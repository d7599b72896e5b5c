"""An objective that pays in place of the task's reward."""

import numpy as np
import pytest

from latentplan.config import Config, EnvConfig, RunConfig, UserError
from latentplan.envs import make_env
from latentplan.evaluation.goals import ScoredEnv, read_goals
from latentplan.training import train

OBJECTIVE = "0.5 * (cart -> 0.5 and upright > 0.9) + 0.1 * abs(pole_speed) + 0.25 * task(balance)"


def config(objective):
    return EnvConfig(domain="cartpole", render_quality="fastest", action_repeat=8, objective=objective)


def returns(env, seed):
    """Returns of a whole episode of random actions."""
    env.reset(seed=seed)
    rng, total, over = np.random.default_rng(seed), 0.0, False
    while not over:
        _, reward, terminated, truncated, _ = env.step(rng.uniform(-1.0, 1.0, 1))
        total += reward
        over = terminated or truncated
    return total


def test_what_is_earned_is_what_evaluation_scores():
    paid, plain = make_env(config(OBJECTIVE)), make_env(config(None))
    scored = ScoredEnv(plain, read_goals(OBJECTIVE, None, "cartpole"))
    earned, task_return = returns(paid, 3), returns(scored, 3)
    assert earned == pytest.approx(scored.scores[0].objective_return, rel=1e-9)
    assert abs(earned - task_return) > 10.0
    paid.close()
    scored.close()


def test_a_score_for_the_return_counts_what_is_paid():
    env = make_env(config("upright > 0.5"))
    scored = ScoredEnv(env, read_goals("return", None, "cartpole"))
    assert scored.scores == [] and returns(scored, 1) == pytest.approx(scored.scores[0].objective_return)
    scored.close()


@pytest.mark.parametrize(
    "objective", ["return", "0.5 * (cart -> 0.5) + return", "goal:x.png", "carts > 0.5", "cart >", ""]
)
def test_what_is_no_function_of_quantities_is_refused(objective):
    with pytest.raises(UserError):
        make_env(config(objective))


def test_an_environment_of_the_users_own_pays_its_own_reward(tmp_path):
    settings = Config(env=config("cart > 0"), run=RunConfig(frames=100, run_dir=str(tmp_path / "run")))
    with pytest.raises(UserError, match="returns its own reward"):
        train(settings, make_env=lambda: None)
    assert not (tmp_path / "run").exists()
