"""A vector environment behaves like the same environments one by one."""

import os

import numpy as np
import pytest

from latentplan.config import EnvConfig
from latentplan.config.checks import EnvironmentFault
from latentplan.envs import make_env, make_vector_env

CONFIG = EnvConfig(domain="cartpole", render_quality="fastest", action_repeat=250)  # four decisions an episode
ACTIONS = np.random.default_rng(0).uniform(-1.0, 1.0, (6, 2, 1)).astype(np.float32)


@pytest.fixture(scope="module")
def pair():
    make_env(CONFIG).close()  # loads MuJoCo, which sets an environment variable the first time
    before = dict(os.environ)
    pair = make_vector_env(CONFIG, 2, seed=0)
    assert dict(os.environ) == before
    yield pair
    pair.close()


def test_vector_env_equals_single_environments(pair):
    singles = [make_env(CONFIG, seed=0) for _ in range(2)]
    frames, _ = pair.reset(seed=[3, 4])
    expected = [env.reset(seed=seed)[0] for env, seed in zip(singles, (3, 4), strict=True)]
    assert np.array_equal(frames, expected)
    for actions in ACTIONS[:4]:
        frames, rewards, terminated, truncated, info = pair.step(actions)
        steps = [env.step(action) for env, action in zip(singles, actions, strict=True)]
        assert np.array_equal(frames, [step[0] for step in steps])
        assert np.array_equal(rewards, [step[1] for step in steps])
        assert np.array_equal(truncated, [step[3] for step in steps])
        assert not terminated.any()
        assert np.array_equal(info["env_frames"], [250, 250])
    assert truncated.all()
    for env in singles:
        env.close()


def test_reset_restarts_only_masked_environments(pair):
    pair.reset(seed=[3, 4])
    before, *_ = pair.step(ACTIONS[0])
    after, _ = pair.reset(options={"reset_mask": np.array([True, False])})
    assert not np.array_equal(before[0], after[0])
    assert np.array_equal(before[1], after[1])


def test_frames_are_new_arrays(pair):
    frames, _ = pair.reset(seed=[3, 4])
    copy = frames.copy()
    pair.step(ACTIONS[0])
    assert np.array_equal(frames, copy)


def test_vector_env_of_one_restarts_like_several():
    one = make_vector_env(CONFIG, 1, seed=0)
    first, _ = one.reset()
    for _ in range(4):
        last, _, _, truncated, _ = one.step(np.ones((1, 1), np.float32))
    fresh, _ = one.reset(options={"reset_mask": truncated})
    assert first.shape == last.shape == fresh.shape == (1, 64, 64, 3)
    assert not np.array_equal(last, fresh)
    one.close()


def test_vector_env_calls_a_users_factory_in_every_process():
    import gymnasium
    from gymnasium.spaces import Box

    class Noise(gymnasium.Env):
        observation_space = Box(0, 255, (32, 32, 3), np.uint8)
        action_space = Box(-2.0, 2.0, (2,), np.float32)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return self.np_random.integers(0, 256, (32, 32, 3), np.uint8), {}

        def step(self, action):
            return self.np_random.integers(0, 256, (32, 32, 3), np.uint8), float(action[0]), False, False, {}

    pair, alone = (make_vector_env(EnvConfig(), count, seed=9, make_env=lambda: Noise()) for count in (2, 1))
    pictures = pair.reset()[0]
    _, rewards, *_ = pair.step(np.array([[1.0, 0.0], [0.5, 0.0]], np.float32))
    pair.close()
    assert np.array_equal(pictures[0], alone.reset()[0][0])  # the same seed and index give the same stream
    assert not np.array_equal(pictures[0], pictures[1])  # each environment has another stream
    assert np.array_equal(rewards, [4.0, 2.0])  # action repeat 2


@pytest.mark.parametrize(
    ("call", "arguments"),
    [
        ("step", {"actions": ACTIONS[0][:1]}),
        ("step", {"actions": np.zeros((3, 1), np.float32)}),
        ("step", {"actions": np.float32(0.5)}),
        ("reset", {"seed": [1]}),
        ("reset", {"options": {"reset_mask": np.ones(3, bool)}}),
    ],
)
def test_refused_call_leaves_no_answer_behind(pair, call, arguments):
    expected = begin_and_step(pair)
    pair.reset(seed=[3, 4])
    with pytest.raises(ValueError, match="one entry for each of 2 environments"):
        getattr(pair, call)(**arguments)
    assert np.array_equal(pair.step(ACTIONS[0])[0], expected)


def test_answer_that_an_interrupted_step_leaves_is_dropped(pair, monkeypatch):
    expected = begin_and_step(pair)
    pair.reset(seed=[3, 4])

    def interrupt():
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(pair.lanes[0], "answer", interrupt)
        with pytest.raises(KeyboardInterrupt):
            pair.step(ACTIONS[1])
    pair.reset(seed=[3, 4])
    assert np.array_equal(pair.step(ACTIONS[0])[0], expected)


def begin_and_step(pair):
    pair.reset(seed=np.int64(3))  # the second environment has the seed 4
    return pair.step(ACTIONS[0])[0]


def test_reset_takes_the_answers_of_all_environments_before_it_fails():
    import gymnasium
    from gymnasium.spaces import Box

    class Moody(gymnasium.Env):
        observation_space = Box(0, 255, (8, 8, 3), np.uint8)
        action_space = Box(-1.0, 1.0, (1,), np.float32)

        def reset(self, *, seed=None, options=None):
            if seed == 13:
                raise RuntimeError("no start")
            return np.full((8, 8, 3), seed, np.uint8), {}

        def step(self, action):
            return np.zeros((8, 8, 3), np.uint8), 0.0, False, False, {}

    envs = make_vector_env(EnvConfig(action_repeat=1), 2, 0, make_env=lambda: gymnasium.wrappers.TimeLimit(Moody(), 5))
    with pytest.raises(EnvironmentFault, match="no start"):
        envs.reset(seed=[13, 5])
    frames, _ = envs.reset(seed=[7, 9])
    assert frames[0].max() == 7
    assert frames[1].max() == 9
    envs.close()


def test_vector_environment_has_an_environment():
    with pytest.raises(ValueError, match="num_envs must be at least 1"):
        make_vector_env(CONFIG, 0, seed=0)
