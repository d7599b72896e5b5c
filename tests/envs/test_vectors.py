"""Numbers beside the pictures: which keys are accepted, and what the environments report."""

import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete

from latentplan.config import EnvConfig, EnvironmentFault, UserError
from latentplan.envs import accept_spaces, make_env, make_from, make_vector_env, wrap_user_env
from tests.envs.test_observations import ACTIONS, RGB, Still, bytes_box

SPACE = Dict(
    {
        "camera": bytes_box(20, 30, 3),
        "joints": Box(-np.inf, np.inf, (2, 2)),
        "load": Box(0, 9, (), np.int64),
        "gear": Discrete(3),
    }
)
VALUES = {"camera": RGB, "joints": np.array([[1.0, 2.0], [3.0, -4.0]]), "load": 7, "gear": 1}
BOTH = EnvConfig(vectors=("load", "joints"))


def make_still():
    return Still(SPACE, VALUES)


def test_vectors_are_reported_in_the_order_of_the_settings():
    env = wrap_user_env(make_still(), config=BOTH)
    assert env.spaces.vector_dim == 5 and env.observation_space.shape == (64, 64, 3)
    expected = [7.0, 1.0, 2.0, 3.0, -4.0]
    assert env.reset()[1]["vectors"].tolist() == expected
    vectors = env.step(np.zeros(1))[4]["vectors"]
    assert vectors.tolist() == expected and vectors.dtype == np.float32


def test_vectors_that_are_not_named_are_not_seen():
    env = wrap_user_env(make_still())
    assert env.spaces.vector_dim == 0 and "vectors" not in env.reset()[1]


def test_vector_that_looks_like_a_picture_is_no_camera():
    space = Dict({"camera": bytes_box(20, 30, 3), "grid": Box(0.0, 1.0, (3, 3), np.float32)})
    accepted = accept_spaces(space, ACTIONS, EnvConfig(vectors=("grid",)))
    assert (accepted.spaces.cameras, accepted.spaces.vector_dim) == (1, 9)
    with pytest.raises(UserError, match="env.cameras and env.vectors both name 'grid'"):
        accept_spaces(space, ACTIONS, EnvConfig(cameras=("camera", "grid"), vectors=("grid",)))
    with pytest.raises(UserError, match="must hold a picture .*beside those that env.vectors names"):
        accept_spaces(space, ACTIONS, EnvConfig(vectors=("grid", "camera")))


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (EnvConfig(vectors=("legs",)), "names 'legs', which observation_space lacks; it has gear, joints, load"),
        (EnvConfig(vectors=("gear",)), "must be a Box of numbers, got Discrete.*TransformObservation"),
    ],
)
def test_other_keys_are_refused_with_the_remedy(config, message):
    with pytest.raises(UserError, match=message):
        accept_spaces(SPACE, ACTIONS, config)
    with pytest.raises(UserError, match="return a Dict with these keys"):
        accept_spaces(SPACE["camera"], ACTIONS, config)


@pytest.mark.parametrize(
    ("joints", "remedy"),
    [
        (np.full((2, 2), np.nan), "return a finite number at every place"),
        (np.zeros(4), "declare in observation_space what it returns"),
        ("text", "return an array of numbers"),
    ],
)
def test_vectors_that_are_not_as_declared_are_a_fault(joints, remedy):
    with pytest.raises(EnvironmentFault, match=f"vectors of finite numbers.*: {remedy}"):
        wrap_user_env(Still(SPACE, VALUES | {"joints": joints}), config=BOTH).reset()


def test_observations_without_a_declared_key_are_a_fault_with_a_remedy():
    with pytest.raises(EnvironmentFault, match="got 'camera': return every key that observation_space declares"):
        wrap_user_env(Still(SPACE, {"camera": RGB}), config=BOTH).reset()


def test_vector_environment_reports_vectors_behind_the_labels():
    envs = make_vector_env(BOTH, 1, 0, make_still)
    assert envs.reset()[1]["labels"].tolist() == [[7.0, 1.0, 2.0, 3.0, -4.0]]
    assert envs.step(np.zeros((1, 1)))[4]["labels"].shape == (1, 5)
    envs.close()
    assert make_from(make_still)(BOTH, 0).spaces.vector_dim == 5


def test_suite_reports_proprioception():
    envs = [
        make_env(EnvConfig(domain="cartpole", vectors=names), seed=0)
        for names in (("proprioception",), ("velocity", "position"))
    ]
    whole, parts = (env.reset(seed=1)[1]["vectors"] for env in envs)
    assert whole.shape == (5,) and whole.dtype == np.float32
    assert np.array_equal(parts, np.concatenate([whole[3:], whole[:3]]))
    assert envs[0].step(np.ones(1))[4]["vectors"].shape == (5,)
    with pytest.raises(UserError, match="names 'touch'; the task has position, velocity, proprioception"):
        make_env(EnvConfig(domain="cartpole", vectors=("touch",)))
