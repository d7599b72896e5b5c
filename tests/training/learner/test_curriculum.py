"""Curriculum: rewards of another task first, then the run's own."""

import numpy as np
import pytest
import torch

from latentplan.config import Config, EnvConfig, LearningConfig, UserError
from latentplan.config.quantities import scales as quantity_scales
from latentplan.envs import make_env
from latentplan.envs.true_quantities import ObjectiveReward
from latentplan.training.learner.curriculum import Curriculum, sum_rewards
from latentplan.training.state import RunState

LABELS = {"height": 0.2, "task.stand": 1.0, "task.walk": 1.0}


def make_config(name, action_repeat=1, frames=100, **env):
    """Makes the settings of a run with a curriculum of 100 frames for a task or expression."""
    learning = LearningConfig(curriculum_task=name, curriculum_frames=frames)
    return Config(env=EnvConfig(action_repeat=action_repeat, **env), learning=learning)


def state_at(env_frames):
    return RunState(env_frames=env_frames)


@pytest.fixture
def labelled(batch):
    labels = torch.rand(4, 6, 3, generator=torch.Generator().manual_seed(0))
    return batch._replace(labels=labels)


def test_curriculum_gives_the_rewards_of_its_task_until_its_frames_are_over(labelled):
    state = state_at(0)
    curriculum = Curriculum(make_config("stand"), LABELS, state)
    for state.env_frames in (0, 99):
        assert torch.equal(curriculum(labelled).rewards, labelled.labels[:, 1:, 1])
    state.env_frames = 100
    assert curriculum(labelled) is labelled


def test_curriculum_changes_only_the_rewards(labelled):
    changed = Curriculum(make_config("walk", action_repeat=2), LABELS, state_at(0))(labelled)
    for name in set(labelled._fields) - {"rewards"}:
        assert getattr(changed, name) is getattr(labelled, name)


def test_curriculum_returns_the_same_batch_without_another_task(labelled):
    assert Curriculum(make_config(None), LABELS, state_at(0))(labelled) is labelled
    assert Curriculum(make_config("walk", task="walk"), LABELS, state_at(0))(labelled) is labelled
    assert Curriculum(make_config("walk", task="walk"), {}, state_at(0))(labelled) is labelled


@pytest.mark.parametrize("task", ["walk", "stand"])
def test_curriculum_may_precede_an_objective(labelled, task):
    state = state_at(99)
    curriculum = Curriculum(make_config("walk", task=task, objective="speed -> 2.0"), LABELS, state)
    assert torch.equal(curriculum(labelled).rewards, labelled.labels[:, 1:, 2])
    state.env_frames = 100
    assert curriculum(labelled) is labelled


@pytest.mark.parametrize(("labels", "tasks"), [(LABELS, "stand, walk"), ({}, "none")])
def test_curriculum_refuses_an_unknown_task(labels, tasks):
    with pytest.raises(UserError, match=f"curriculum_task 'fly' is unknown; .*: {tasks}; as an expression: .*fly"):
        Curriculum(make_config("fly"), labels, state_at(0))


@pytest.mark.parametrize("text", ["return", "height + goal:nowhere.png"])
def test_curriculum_refuses_an_expression_over_unlabelled_values(text):
    with pytest.raises(UserError, match="curriculum_task"):
        Curriculum(make_config(text), LABELS, state_at(0))


def test_curriculum_computes_an_expression_over_labels(labelled):
    height, stand, _ = labelled.labels[:, 1:].unbind(-1)
    changed = Curriculum(make_config("2 * height - task(stand)"), LABELS, state_at(0))(labelled)
    assert torch.allclose(changed.rewards, 2 * height - stand)
    clause = Curriculum(make_config("height > 0.6"), LABELS, state_at(0))(labelled)
    missing = (0.6 - height).clamp_min(0.0) / 0.2
    assert torch.allclose(clause.rewards, 0.1 ** missing.square())


def test_curriculum_gives_the_reward_of_the_same_objective(labelled):
    text, scales = "upright - 0.2 * abs(pole_speed) + (upright > 0.5 and pole_speed < 1.0)", quantity_scales("pendulum")
    labels = torch.randn(4, 6, len(scales), generator=torch.Generator().manual_seed(0))
    paid = ObjectiveReward(text, "pendulum")
    expected = [[paid(row) for row in rows[1:].double().numpy()] for rows in labels]
    config = make_config(text, domain="pendulum", task="swingup")
    changed = Curriculum(config, scales, state_at(0))(labelled._replace(labels=labels))
    assert torch.allclose(changed.rewards.double(), torch.tensor(expected, dtype=torch.float64), atol=1e-5)


@pytest.mark.parametrize("action_repeat", [1, 2, 4, 8])
def test_sum_rewards_is_exact_for_linear_rewards(action_repeat):
    steps = torch.arange(3 * action_repeat + 1.0)
    expected = steps[1:].reshape(3, action_repeat).sum(-1)
    assert torch.allclose(sum_rewards(steps[None, ::action_repeat], action_repeat), expected[None])


@pytest.mark.parametrize(("action_repeat", "error"), [(1, 1e-6), (2, 0.04)])
def test_sum_rewards_of_labels_matches_the_rewards_of_the_task(action_repeat, error):
    """Labels of an episode, summed for its own task, give the episode's rewards; exactly with an action repeat of 1."""
    env = make_env(EnvConfig("walker", "walk", action_repeat, render_quality="fastest"), seed=0)
    rng = np.random.default_rng(0)
    try:
        _, info = env.reset(seed=0)
        labels, rewards = [info["labels"]], []
        for _ in range(30):
            _, reward, _, _, info = env.step(rng.uniform(-1.0, 1.0, 6).astype(np.float32))
            labels.append(info["labels"])
            rewards.append(reward)
        column = list(env.unwrapped.labels).index("task.walk")
    finally:
        env.close()
    walk = torch.tensor(np.array(labels), dtype=torch.float32)[None, :, column]
    assert (sum_rewards(walk, action_repeat)[0] - torch.tensor(rewards)).abs().mean() < error


class Learner:
    """Counts resets of the value head."""

    num_resets = 0

    def reset_value_head(self):
        self.num_resets += 1


@pytest.mark.parametrize(("task", "frames", "times"), [("stand", 100, 1), ("stand", 0, 0), (None, 100, 0)])
def test_curriculum_resets_the_value_head_once_also_when_resumed(task, frames, times):
    learner, state = Learner(), state_at(99)
    curriculum = Curriculum(make_config(task, frames=frames), LABELS, state)
    curriculum.on_train_epoch_start(None, learner)
    assert learner.num_resets == 0
    state.env_frames = 101
    curriculum.on_train_epoch_start(None, learner)
    resumed = Curriculum(make_config(task, frames=frames), LABELS, RunState(**state.to_dict()))
    for each in (curriculum, resumed):
        each.on_train_epoch_start(None, learner)
    assert learner.num_resets == times


def test_curriculum_is_skipped_when_its_task_is_the_objective(labelled):
    learner, state = Learner(), state_at(0)
    curriculum = Curriculum(make_config("height", objective="height"), LABELS, state)
    assert curriculum(labelled) is labelled and curriculum.note == ""
    state.env_frames = 101
    curriculum.on_train_epoch_start(None, learner)
    assert learner.num_resets == 0


def test_note_describes_the_curriculum():
    assert (
        Curriculum(make_config("stand", frames=40_000), LABELS, state_at(0)).note == "; first stand, for 40,000 frames"
    )
    assert Curriculum(make_config("stand", frames=0), LABELS, state_at(0)).note == ""
