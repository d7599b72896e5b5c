"""Rewards of a sibling task, learned first."""

import numpy as np
import pytest
import torch

from latentplan.config import Config, EnvConfig, LearningConfig, UserError
from latentplan.config.quantities import scales as quantity_scales
from latentplan.envs import make_env
from latentplan.envs.reward import ObjectiveReward
from latentplan.training.learner.curriculum import Curriculum, summed_reward
from latentplan.training.state import RunState

LABELS = {"height": 0.2, "task.stand": 1.0, "task.walk": 1.0}


def first(name, action_repeat=1, frames=100, **env):
    """The settings of a run whose first 100 frames are for a task."""
    learning = LearningConfig(curriculum_task=name, curriculum_frames=frames)
    return Config(env=EnvConfig(action_repeat=action_repeat, **env), learning=learning)


def at(env_frames):
    return RunState(env_frames=env_frames)


@pytest.fixture
def labelled(batch):
    labels = torch.rand(4, 6, 3, generator=torch.Generator().manual_seed(0))
    return batch._replace(labels=labels)


def test_rewards_are_the_sibling_task_s_until_its_frames_are_over(labelled):
    state = at(0)
    curriculum = Curriculum(first("stand"), LABELS, state)
    for state.env_frames in (0, 99):
        assert torch.equal(curriculum(labelled).rewards, labelled.labels[:, 1:, 1])
    state.env_frames = 100
    assert curriculum(labelled) is labelled


def test_nothing_but_the_rewards_changes(labelled):
    changed = Curriculum(first("walk", action_repeat=2), LABELS, at(0))(labelled)
    for name in set(labelled._fields) - {"rewards"}:
        assert getattr(changed, name) is getattr(labelled, name)


def test_without_another_task_the_batch_is_what_it_was(labelled):
    assert Curriculum(first(None), LABELS, at(0))(labelled) is labelled
    assert Curriculum(first("walk", task="walk"), LABELS, at(0))(labelled) is labelled
    assert Curriculum(first("walk", task="walk"), {}, at(0))(labelled) is labelled


@pytest.mark.parametrize("task", ["walk", "stand"])
def test_an_objective_can_follow_any_task(labelled, task):
    state = at(99)
    curriculum = Curriculum(first("walk", task=task, objective="speed -> 2.0"), LABELS, state)
    assert torch.equal(curriculum(labelled).rewards, labelled.labels[:, 1:, 2])
    state.env_frames = 100
    assert curriculum(labelled) is labelled


@pytest.mark.parametrize(("labels", "told"), [(LABELS, "stand, walk"), ({}, "none")])
def test_a_task_that_the_simulator_does_not_tell_of_is_refused(labels, told):
    with pytest.raises(UserError, match=f"curriculum_task 'fly' is unknown; .*: {told}; as an expression: .*fly"):
        Curriculum(first("fly"), labels, at(0))


@pytest.mark.parametrize("text", ["return", "height + goal:nowhere.png"])
def test_a_reward_that_no_quantity_tells_is_refused(text):
    with pytest.raises(UserError, match="curriculum_task"):
        Curriculum(first(text), LABELS, at(0))


def test_an_expression_can_come_first(labelled):
    height, stand, _ = labelled.labels[:, 1:].unbind(-1)
    changed = Curriculum(first("2 * height - task(stand)"), LABELS, at(0))(labelled)
    assert torch.allclose(changed.rewards, 2 * height - stand)
    clause = Curriculum(first("height > 0.6"), LABELS, at(0))(labelled)
    missing = (0.6 - height).clamp_min(0.0) / 0.2
    assert torch.allclose(clause.rewards, 0.1 ** missing.square())


def test_an_expression_pays_what_it_pays_as_the_objective_of_a_run(labelled):
    text, scales = "upright - 0.2 * abs(pole_speed) + (upright > 0.5 and pole_speed < 1.0)", quantity_scales("pendulum")
    labels = torch.randn(4, 6, len(scales), generator=torch.Generator().manual_seed(0))
    paid = ObjectiveReward(text, "pendulum")
    expected = [[paid(row) for row in rows[1:].double().numpy()] for rows in labels]
    config = first(text, domain="pendulum", task="swingup")
    changed = Curriculum(config, scales, at(0))(labelled._replace(labels=labels))
    assert torch.allclose(changed.rewards.double(), torch.tensor(expected, dtype=torch.float64), atol=1e-5)


@pytest.mark.parametrize("action_repeat", [1, 2, 4, 8])
def test_a_reward_that_changes_evenly_is_summed_exactly(action_repeat):
    steps = torch.arange(3 * action_repeat + 1.0)
    expected = steps[1:].reshape(3, action_repeat).sum(-1)
    assert torch.allclose(summed_reward(steps[None, ::action_repeat], action_repeat), expected[None])


@pytest.mark.parametrize(("action_repeat", "error"), [(1, 1e-6), (2, 0.04)])
def test_it_comes_to_what_the_task_pays(action_repeat, error):
    """The labels of an episode of one task, summed for that same task, give its rewards: exactly without repeats."""
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
    assert (summed_reward(walk, action_repeat)[0] - torch.tensor(rewards)).abs().mean() < error


class Learner:
    """Counts how often it forgets."""

    forgotten = 0

    def forget_values(self):
        self.forgotten += 1


@pytest.mark.parametrize(("task", "frames", "times"), [("stand", 100, 1), ("stand", 0, 0), (None, 100, 0)])
def test_values_of_another_reward_are_forgotten_once_also_by_a_run_that_is_resumed(task, frames, times):
    learner, state = Learner(), at(99)
    curriculum = Curriculum(first(task, frames=frames), LABELS, state)
    curriculum.on_train_epoch_start(None, learner)
    assert learner.forgotten == 0
    state.env_frames = 101
    curriculum.on_train_epoch_start(None, learner)
    resumed = Curriculum(first(task, frames=frames), LABELS, RunState(**state.to_dict()))
    for each in (curriculum, resumed):
        each.on_train_epoch_start(None, learner)
    assert learner.forgotten == times


def test_an_objective_that_is_what_would_come_first_is_learned_from_the_start(labelled):
    learner, state = Learner(), at(0)
    curriculum = Curriculum(first("height", objective="height"), LABELS, state)
    assert curriculum(labelled) is labelled and curriculum.note == ""
    state.env_frames = 101
    curriculum.on_train_epoch_start(None, learner)
    assert learner.forgotten == 0


def test_a_run_says_what_comes_first():
    assert Curriculum(first("stand", frames=40_000), LABELS, at(0)).note == "; first stand, for 40,000 frames"
    assert Curriculum(first("stand", frames=0), LABELS, at(0)).note == ""
