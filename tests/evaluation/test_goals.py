"""Goals given after training: scores come from the simulator, and planning agents pursue the goals."""

import contextlib
import functools
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from dm_control.utils.rewards import tolerance

from latentplan.agents.checkpoint import load_agent, save_checkpoint
from latentplan.agents.planning import PlanningAgent
from latentplan.agents.random import RandomAgent
from latentplan.commands.main import main
from latentplan.config import Config, EnvConfig, ModelConfig, PlannerConfig, UserError
from latentplan.config.quantities import scales
from latentplan.envs import make_env
from latentplan.envs.true_quantities import true_values
from latentplan.evaluation.episodes import run_episodes
from latentplan.evaluation.goals import ScoredEnv, read_goals, score_env
from latentplan.models import WorldModel
from latentplan.planning.objectives import learned_return

ENV = EnvConfig(domain="cartpole", task="swingup", action_repeat=100, render_quality="fastest")
MODEL = ModelConfig(deter_dim=8, hidden_dim=8, decoder_width=4, encoder_channels=(4, 4), decoder_channels=2, num_bins=5)
PLANNER = PlannerConfig(horizon=3, num_samples=8, num_elites=2, num_policy_samples=1, num_iterations=2)
CONFIG = Config(env=ENV, model=MODEL, planner=PLANNER)


@pytest.fixture(scope="module")
def env():
    env = make_env(ENV, seed=0)
    yield env
    env.close()


def save_agent(folder, labels):
    torch.manual_seed(0)
    info = {"domain": "cartpole", "task": "swingup", "env_frames": 1234, "discount": 0.9, "metrics": {}}
    save_checkpoint(folder, WorldModel(MODEL, 1, labels), CONFIG, info)
    return folder


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    """An untrained agent that predicts the quantities of cartpole, for episodes of ten decisions."""
    return save_agent(tmp_path_factory.mktemp("agent"), scales("cartpole"))


@pytest.fixture(scope="module")
def old_checkpoint(tmp_path_factory):
    """An agent that predicts no quantities."""
    return save_agent(tmp_path_factory.mktemp("old"), {})


def evaluate_agent(folder, tmp_path, *flags, episodes=1):
    result = tmp_path / "result.json"
    arguments = ["--checkpoint", folder, "--json", result, "--device", "cpu", "--episodes", episodes, *flags]
    assert main(["eval", *map(str, arguments)]) == 0
    return json.loads(result.read_text())


def error_of(capsys, *flags):
    assert main(["eval", *map(str, flags)]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("error: ") and captured.err.count("\n") == 1
    return captured.err


@functools.cache
def true_cartpole(seed):
    """Quantities by name, (control step,) each, and rewards of a random episode, read from dm_control itself."""
    env = make_env(ENV)
    agent = RandomAgent(1)
    env.reset(seed=seed)
    agent.seed(7)
    action, values, rewards = None, [], []
    for step in range(1000):
        action = agent.act(np.zeros((64, 64, 3), np.uint8)) if step % 100 == 0 else action
        rewards.append(env._task_env.step(action).reward)  # without rendering; the control range is [-1, 1]
        values.append(true_values("cartpole", env.physics))
    env.close()
    return dict(zip(scales("cartpole"), np.array(values).T, strict=True)), np.array(rewards)


def played(env, objective=None, constraint=None, seed=3):
    """The environment after a random episode under a goal."""
    scored = ScoredEnv(env, read_goals(objective, constraint, "cartpole"))
    agent = RandomAgent(1)
    frame, _ = scored.reset(seed=seed)
    agent.seed(7)
    over = False
    while not over:
        frame, _, terminated, truncated, _ = scored.step(agent.act(frame))
        over = terminated or truncated
    return scored


def test_objective_return_sums_the_true_degree_of_every_control_step(env):
    truth, rewards = true_cartpole(seed=3)
    near = tolerance(truth["cart"], (0.3, 0.3), margin=0.5)
    slow = tolerance(np.abs(truth["pole_speed"]), (-np.inf, 1.0), margin=2.0)
    scores = {
        "cart -> 0.3": near.sum(),
        "cart -> 0.3 and abs(pole_speed) < 1": (near * slow).sum(),
        "0.7 * task(swingup) + 0.3 * (cart -> 0.3)": (0.7 * truth["task.swingup"] + 0.3 * near).sum(),
        "2 * return - cart": (2 * rewards - truth["cart"]).sum(),
        "cart -> 0.3; 250: abs(pole_speed) < 1": near[:250].sum() + slow[250:].sum(),
    }
    found = {text: played(env, text).scores[0].objective_return for text in scores}
    assert found == pytest.approx(scores, rel=1e-6)
    assert rewards == pytest.approx(truth["task.swingup"], abs=1e-6)


def test_violation_rate_counts_control_steps(env):
    truth, _ = true_cartpole(seed=3)
    limit = float(np.median(truth["cart"]))
    broken = (truth["cart"] >= limit) | (truth["upright"] <= 0.0)
    rate = played(env, constraint=f"cart < {limit}; upright > 0").scores[0].violation_rate
    assert 0.5 <= rate == pytest.approx(broken.mean(), abs=0.003)  # rounding decides where a value equals the limit


def test_scored_env_scores_each_episode_on_its_own(env):
    scored = ScoredEnv(env, read_goals("cart > 0; 500: cart < 0", None, "cartpole"))
    run_episodes(scored, RandomAgent(1), [5, 6, 5])
    first, other, again = (score.objective_return for score in scored.scores)
    assert first == again != other
    assert scored.summarize(2)["objective_returns"] == [first, other]


def test_score_that_is_not_finite_is_refused(env):
    with pytest.raises(UserError, match="a score that is not finite: inf"):
        played(env, "abs(1e200*cart)*1e200")


def test_scored_env_reports_each_change_of_the_objective(env):
    changes = []
    goals = read_goals("cart > 0; 250: cart < 0; 260: upright", None, "cartpole")
    scored = ScoredEnv(env, goals, lambda objective: changes.append((len(scored.objective_scores), objective.text)))
    run_episodes(scored, RandomAgent(1), [5, 5])
    # A decision lasts 100 control steps: at frame 300 the objective from 260 on replaces the objective from 250 on.
    assert changes == [(0, "cart > 0"), (300, "upright")] * 2


def test_scored_env_scores_goal_images_by_the_cameras_frame(env, tmp_path):
    frame, _ = env.reset(seed=3)
    for shift in (0, 40):
        path = tmp_path / f"goal{shift}.png"
        cv2.imwrite(str(path), cv2.cvtColor(np.clip(frame.astype(int) + shift, 0, 255).astype(np.uint8), 4))
    scored = ScoredEnv(env, read_goals(f"goal:{tmp_path}/goal0.png", None, "cartpole"))
    scored.reset(seed=3)
    scored.step(np.zeros(1))
    assert 0.0 < min(scored.objective_scores) and max(scored.objective_scores) <= 1.0
    other = ScoredEnv(env, read_goals(f"goal:{tmp_path}/goal40.png", None, "cartpole"))
    other.reset(seed=3)
    other.step(np.zeros(1))
    assert max(other.objective_scores) < min(scored.objective_scores)


def make_picture(path):
    cv2.imwrite(str(path), np.full((64, 64, 3), 90, np.uint8))
    return f"goal:{path}"


@pytest.mark.parametrize("size", [84, 128])
def test_scored_env_reads_a_goal_image_at_the_size_of_the_frames(tmp_path, size):
    goals = read_goals(make_picture(tmp_path / "goal.png"), None, "cartpole")
    with contextlib.closing(make_env(replace(ENV, frame_size=size))) as env:
        scored = ScoredEnv(env, goals)
        scored.reset(seed=3)
        scored.step(np.zeros(1))
    assert len(scored.objective_scores) == 100 and 0.0 < min(scored.objective_scores) <= 1.0


def test_scored_env_refuses_a_goal_image_where_frames_hold_several_cameras(tmp_path):
    image = make_picture(tmp_path / "goal.png")
    with contextlib.closing(make_env(replace(ENV, cameras=("0", "1")))) as env:
        with pytest.raises(UserError, match="goal image shows one camera, and the frames of this environment show 2"):
            ScoredEnv(env, read_goals(f"cart > 0; 500: {image}", None, "cartpole"))
        ScoredEnv(env, read_goals("cart > 0", None, "cartpole"))


@pytest.mark.parametrize("mode", ["planner", "gated", "background", "actor", "random"])
def test_evaluate_reports_scores_in_every_mode_and_planners_pursue_them(tmp_path, checkpoint, mode):
    flags = ["--objective", "cart -> 1.5", "--constraint", "cart < 1.4", "--constraint=cart > -1.4", "--mode", mode]
    result = evaluate_agent(checkpoint, tmp_path, *flags, episodes=2)
    assert (result["objective"], result["constraint"]) == ("cart -> 1.5", "cart < 1.4; cart > -1.4")
    assert len(result["objective_returns"]) == len(result["returns"]) == 2
    assert result["objective_return"] == pytest.approx(np.mean(result["objective_returns"]))
    assert 0.0 < result["objective_return"] <= 1000.0
    assert 0.0 <= result["violation_rate"] <= 1.0
    assert result["floor"] == "endless"
    assert -1.8 <= result["quantities"]["cart"] <= 1.8
    assert 1000.0 * result["quantities"]["task.swingup"] == pytest.approx(result["mean_return"])
    plain = evaluate_agent(checkpoint, tmp_path, "--mode", mode)
    assert not {"objective", "objective_return", "violation_rate"} & plain.keys()
    assert plain["floor"] == "suite"
    is_pursued = plain["returns"][0] != result["returns"][0]  # the floor is not part of the physics
    assert is_pursued == (mode in ("planner", "gated", "background"))


def test_set_objective_keeps_the_trained_objective_with_a_constraint_alone(checkpoint):
    agent = load_agent(checkpoint)
    agent.set_objective(None, "cart < 0.5")
    assert agent.controller.objective is None and len(agent.controller.constraints) == 1


def test_set_objective_takes_text_terms_and_none(checkpoint):
    agent, frame = load_agent(checkpoint), np.zeros((64, 64, 3), np.uint8)
    for objective in ("abs(cart) < 0.2 and upright > 0.9", learned_return(), None):
        agent.set_objective(objective)
        assert agent.act(frame).shape == (1,)
    assert agent.controller.objective is None


@pytest.mark.parametrize(
    ("flags", "reason"),
    [
        (("--objective", "crat > 1"), "Did you mean 'cart'?"),
        (("--objective", "height > 1"), "available: cart, pole_angle"),
        (("--objective", "cart > 1; cart < 1"), "env frame"),
        (("--constraint", "cart -> 1"), "a constraint is an inequality"),
        (("--objective", "goal:nowhere.png"), "'nowhere.png' does not exist"),
    ],
)
def test_evaluate_explains_bad_goals_in_one_line(capsys, checkpoint, flags, reason):
    assert reason in error_of(capsys, "--checkpoint", checkpoint, *flags)


def test_evaluate_scores_an_agent_without_quantities_but_refuses_to_plan(capsys, tmp_path, old_checkpoint):
    error = error_of(capsys, "--checkpoint", old_checkpoint, "--objective", "cart > 1", "--device", "cpu")
    assert "trained without named quantities" in error
    result = evaluate_agent(old_checkpoint, tmp_path, "--objective", "cart > 1", "--mode", "actor")
    assert result["objective_return"] > 0


def test_score_env_refuses_a_later_objective_before_the_first_episode(env):
    agent = PlanningAgent(WorldModel(MODEL, 1, {"cart": 0.5}), CONFIG, 0.9)
    with pytest.raises(UserError, match="upright"):
        score_env(env, read_goals("cart > 1; 500: upright > 0", None, "cartpole"), agent)


def test_evaluate_films_a_taller_picture_when_goals_are_given(tmp_path, checkpoint):
    shapes = []
    for index, flags in enumerate([(), ("--objective", "cart -> 0.5 and upright > 0", "--constraint", "cart < 0.4")]):
        path = tmp_path / f"film{index}.mp4"
        evaluate_agent(checkpoint, tmp_path, "--video", path, *flags)
        capture = cv2.VideoCapture(str(path))
        shapes.append(capture.read()[1].shape)
    assert shapes[1][0] > shapes[0][0] and shapes[1][1] == shapes[0][1]


def test_read_goals_returns_none_when_no_goal_is_named():
    assert read_goals(None, None, "cartpole") is None and read_goals(None, " ; ", "cartpole") is None
