"""A user's environment gets frames of 64 x 64 and actions in [-1, 1], or is refused with a reason."""

from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box
from gymnasium.wrappers import TimeLimit

from latentplan.config import USER_DOMAIN, EnvConfig, EnvironmentFault, UserError
from latentplan.envs import make_env, make_from, make_vector_env, user, wrap_user_env

IMAGE = Box(0, 255, (48, 96, 3), np.uint8)
ACTIONS = Box(np.array([0.0, -4.0], np.float32), np.array([2.0, 4.0], np.float32))


class Clock(gymnasium.Env):
    """The pixels hold the number of steps taken; the reward is the first entry of the action."""

    def __init__(self, observation_space=IMAGE, action_space=ACTIONS):
        self.observation_space = observation_space
        self.action_space = action_space
        self.picture = np.zeros(observation_space.shape or (1,), np.uint8)
        self.actions = []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.picture[:] = 0
        return self.picture, {"start": self.np_random.random()}

    def step(self, action):
        self.actions.append(action)
        self.picture += 1  # the same array at every step, so that the wrapper has to copy it
        return self.picture, action[0], bool(self.picture.max() == 7), False, {}


def test_frames_are_resized_new_arrays():
    env = wrap_user_env(Clock())
    first, _ = env.reset()
    second, *_ = env.step(np.zeros(2))
    assert first.shape == second.shape == (64, 64, 3)
    assert (first == 0).all() and (second == 1).all()
    assert env.render_large(256).shape == (256, 256, 3)


def test_frames_are_copied_when_the_size_fits():
    env = wrap_user_env(Clock(Box(0, 255, (64, 64, 3), np.uint8)))
    first, _ = env.reset()
    env.step(np.zeros(2))
    assert (first == 0).all()


def test_step_scales_actions_to_the_users_bounds():
    clock = Clock()
    env = wrap_user_env(clock)
    env.reset()
    for action in ([-1.0, -1.0], [0.0, 0.5], [1.0, 3.0]):
        env.step(np.array(action))
    assert np.allclose(clock.actions, [[0.0, -4.0], [1.0, 2.0], [2.0, 4.0]])
    assert clock.actions[0].dtype == np.float32


def test_every_step_gets_the_action_though_the_environment_changes_it():
    class Doubling(Clock):
        def step(self, action):
            self.actions.append(action.copy())
            action *= 2.0
            return super().step(action)

    clock = Doubling()
    env = wrap_user_env(clock, action_repeat=3)
    env.reset()
    env.step(np.array([0.0, 0.5]))
    assert np.allclose(clock.actions[::2], [[1.0, 2.0]] * 3)


def test_step_sums_rewards_and_stops_at_the_end_of_the_episode():
    env = wrap_user_env(Clock(), action_repeat=4)
    env.reset()
    _, reward, terminated, _, info = env.step(np.ones(2))
    assert (reward, terminated, info["env_frames"]) == (8.0, False, 4)
    frame, reward, terminated, _, info = env.step(np.ones(2))
    assert (reward, terminated, info["env_frames"]) == (6.0, True, 3)
    assert (frame == 7).all()


def test_decisions_per_episode_follows_from_the_time_limit():
    assert wrap_user_env(Clock(), action_repeat=4).decisions_per_episode is None
    gymnasium.register("latentplan-test/Clock-v0", lambda: Clock(), max_episode_steps=10)
    limited = gymnasium.make("latentplan-test/Clock-v0", disable_env_checker=True)
    assert isinstance(limited.env, TimeLimit) or isinstance(limited, TimeLimit)
    assert wrap_user_env(limited, action_repeat=4).decisions_per_episode == 3


def test_decisions_per_episode_follows_from_a_wrapper_without_a_spec():
    assert wrap_user_env(TimeLimit(Clock(), 10), action_repeat=4).decisions_per_episode == 3


def test_step_truncates_after_the_longest_episode_without_a_time_limit(monkeypatch):
    monkeypatch.setattr(user, "MAX_DECISIONS", 5)
    env = wrap_user_env(Clock())
    for _ in range(2):
        env.reset()
        ends = [env.step(np.zeros(2))[2:4] for _ in range(5)]
        assert ends == [(False, False)] * 4 + [(False, True)]
    limited = wrap_user_env(TimeLimit(Clock(), 6))
    limited.reset()
    assert [limited.step(np.zeros(2))[3] for _ in range(6)] == [False] * 5 + [True]


def test_render_fps_is_divided_by_the_action_repeat():
    clock = Clock()
    clock.metadata = {"render_fps": 30}
    assert wrap_user_env(clock, action_repeat=4).metadata["render_fps"] == 7.5
    assert "render_fps" not in wrap_user_env(Clock()).metadata


def test_step_keeps_extreme_actions_within_the_users_bounds():
    for low, high in np.random.default_rng(0).integers(-20, 20, (200, 2)) / 10.0:
        space = Box(np.float32(min(low, high)), np.float32(max(low, high)) + np.float32(0.1), (2,), np.float32)
        clock = Clock(action_space=space)
        env = wrap_user_env(clock)
        env.reset()
        env.step(np.array([-1.0, 1.0]))
        assert space.contains(clock.actions[0])


@pytest.mark.parametrize("action", [np.zeros(1), np.zeros((1, 2)), np.array([0.0, np.nan]), 0.5])
def test_step_refuses_actions_of_another_shape_or_not_finite(action):
    env = wrap_user_env(Clock())
    env.reset()
    with pytest.raises(ValueError, match="finite numbers"):
        env.step(action)


class Shown(Clock):
    """Renders what it is given, or raises it; its observations have the brightness of the steps."""

    metadata, render_mode = {"render_modes": ["rgb_array"]}, "rgb_array"

    def __init__(self, rendered):
        super().__init__()
        self.rendered = rendered

    def render(self):
        if isinstance(self.rendered, Exception):
            raise self.rendered
        return self.rendered


def test_render_large_draws_by_the_users_render():
    env = wrap_user_env(Shown(np.full((20, 20, 3), 9, np.uint8)))
    env.reset()
    assert (env.render_large(96) == 9).all() and env.render_large(96).shape == (96, 96, 3)


@pytest.mark.parametrize(
    "rendered",
    [np.zeros((20, 20), np.uint8), np.full((20, 20, 3), 0.5), None, [[1], [1, 2]], RuntimeError("no display")],
    ids=["gray", "floats", "nothing", "ragged", "error"],
)
def test_render_large_warns_and_shows_the_observation_in_place_of_anything_but_a_picture(rendered):
    env = wrap_user_env(Shown(rendered))
    env.reset()
    env.step(np.zeros(2))
    with pytest.warns(RuntimeWarning, match="films show observations instead"):
        large = env.render_large(96)
    assert large.shape == (96, 96, 3) and large.dtype == np.uint8 and (large == 1).all()


class Talking(Clock):
    """Has entries of its own in its info."""

    def reset(self, *, seed=None, options=None):
        return super().reset(seed=seed)[0], self.own_info()

    def step(self, action):
        return *super().step(action)[:4], self.own_info()

    def own_info(self):
        return {"vectors": "abc", "labels": [1.0, 2.0], "env_frames": "many", "start": 3}


def test_infos_entries_of_the_program_are_never_the_users():
    env = wrap_user_env(Talking(), action_repeat=2)
    assert env.reset()[1] == {"start": 3, "env_frames": 0}
    assert env.step(np.zeros(2))[4] == {"start": 3, "env_frames": 2}
    envs = make_vector_env(EnvConfig(), 1, 0, Talking)
    assert "labels" not in envs.reset()[1]
    assert "labels" not in envs.step(np.zeros((1, 2)))[4]


class Ending(Clock):
    def __init__(self, terminated=False, truncated=False):
        super().__init__()
        self.ends = terminated, truncated

    def step(self, action):
        picture, reward, *_, info = super().step(action)
        return picture, reward, *self.ends, info


@pytest.mark.parametrize("name", ["terminated", "truncated"])
def test_ends_that_are_no_single_truth_are_a_fault_with_a_remedy(name):
    env = wrap_user_env(Ending(**{name: np.zeros(2, bool)}))
    env.reset()
    with pytest.raises(EnvironmentFault, match=f"return {name} as True or False, got .*: return bool"):
        env.step(np.zeros(2))
    env = wrap_user_env(Ending(**{name: np.array([True])}))
    env.reset()
    assert env.step(np.zeros(2))[2:4] == (name == "terminated", name == "truncated")


@pytest.mark.parametrize("pixels", ["observation", "render"])
@pytest.mark.parametrize("env", [None, SimpleNamespace(observation_space=IMAGE, action_space=ACTIONS)])
def test_wrap_user_env_refuses_what_is_no_environment_of_gymnasium(env, pixels):
    with pytest.raises(UserError, match="wrap_user_env takes a gymnasium.Env, got .*: .*shimmy"):
        wrap_user_env(env, config=EnvConfig(pixels=pixels))


@pytest.mark.parametrize("name", ["observation_space", "action_space"])
def test_wrap_user_env_refuses_an_environment_without_a_space(name):
    clock = Clock()
    delattr(clock, name)
    with pytest.raises(UserError, match=f"the environment has no {name}: set it in __init__"):
        wrap_user_env(TimeLimit(clock, 5))


@pytest.mark.parametrize("action_repeat", [0, 2.5])
def test_wrap_user_env_refuses_an_action_repeat_that_counts_no_steps(action_repeat):
    with pytest.raises(UserError, match="action_repeat must be a whole number of at least 1"):
        wrap_user_env(Clock(), action_repeat)


def test_make_from_seeds_the_first_reset_only():
    build = make_from(Clock)
    starts = [build(EnvConfig(), 5).reset()[1]["start"] for _ in range(2)]
    env = build(EnvConfig(), 5)
    assert starts[0] == starts[1] == env.reset()[1]["start"] == env.reset(seed=5)[1]["start"]
    assert env.reset()[1]["start"] != starts[0]


def test_make_env_refuses_the_domain_of_users_environments():
    with pytest.raises(UserError, match="an environment of your own"):
        make_env(EnvConfig(domain=USER_DOMAIN))


def test_make_from_refuses_a_factory_of_something_else():
    with pytest.raises(UserError, match=r"make_env must return a gymnasium.Env, got dict"):
        make_from(dict)(EnvConfig(), 0)
