"""Pictures of any layout become RGB frames, and nothing is cut off silently."""

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete

from latentplan.config import EnvConfig, EnvironmentFault, UserError
from latentplan.config.spaces import FRAME_SIZES
from latentplan.envs import accept_spaces, wrap_user_env
from latentplan.envs.spaces import Picture

RGB = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)
GRAY = RGB[..., 0]
ACTIONS = Box(-1.0, 1.0, (1,), np.float32)


class Still(gymnasium.Env):
    """Always shows the same observation."""

    action_space = ACTIONS

    def __init__(self, observation_space, observation):
        self.observation_space, self.observation = observation_space, observation

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation, {}

    def step(self, action):
        return self.observation, 0.0, False, False, {}


def bytes_box(*shape):
    return Box(0, 255, shape, np.uint8)


@pytest.mark.parametrize(
    ("space", "value", "expected"),
    [
        (bytes_box(20, 30, 3), RGB, RGB),
        (bytes_box(3, 20, 30), RGB.transpose(2, 0, 1), RGB),
        (bytes_box(20, 30), GRAY, np.stack([GRAY] * 3, 2)),
        (bytes_box(20, 30, 1), GRAY[..., None], np.stack([GRAY] * 3, 2)),
        (bytes_box(1, 20, 30), GRAY[None], np.stack([GRAY] * 3, 2)),
        (bytes_box(20, 30, 4), np.concatenate([RGB, np.full((20, 30, 1), 255, np.uint8)], 2), RGB),
        (bytes_box(20, 30, 4), np.concatenate([RGB, np.zeros((20, 30, 1), np.uint8)], 2), np.zeros_like(RGB)),
        (Box(0.0, 1.0, (20, 30, 3), np.float32), RGB / np.float32(255), RGB),
        (Box(0.0, 1.0, (3, 20, 30), np.float64), RGB.transpose(2, 0, 1) / 255.0, RGB),
        (Box(0, 255, (20, 30, 3), np.int64), RGB.astype(np.int64), RGB),
        (Box(0, 1, (20, 30), np.uint8), GRAY // 128, np.stack([GRAY // 128 * 255] * 3, 2)),
    ],
)
def test_pictures_of_any_layout_become_rgb(space, value, expected):
    read = Picture(space, "observation_space").read(value)
    assert read.dtype == np.uint8 and np.array_equal(read, expected)
    assert not np.shares_memory(read, value)


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (Discrete(4), "got Discrete.*AddRenderObservation"),
        (Box(-1.0, 1.0, (17,), np.float32), "AddRenderObservation"),
        (Box(-1.0, 1.0, (64, 64, 3), np.float32), "RescaleObservation"),
        (Box(0.0, 255.0, (64, 64, 3), np.float32), "RescaleObservation"),
        (Box(-np.inf, np.inf, (64, 64, 3), np.float32), "declare their range"),
        (Box(0, 1000, (64, 64, 3), np.int32), "TransformObservation"),
        (bytes_box(4, 64, 64), "without gymnasium.wrappers.FrameStackObservation.*RGBA"),
        (bytes_box(64, 64, 2), "ReshapeObservation"),
        (bytes_box(4, 64, 64, 3), "ReshapeObservation"),
        (Dict({"joints": Box(-1.0, 1.0, (4,))}), "add one to the Dict"),
    ],
)
def test_other_observations_are_refused_with_the_remedy(space, message):
    with pytest.raises(UserError, match=message) as refusal:
        accept_spaces(space, ACTIONS)
    assert "\n" not in str(refusal.value) and "observation_space" in str(refusal.value)


def test_the_remedy_for_other_ranges_works():
    env = gymnasium.wrappers.RescaleObservation(
        Still(Box(-1.0, 1.0, (8, 8, 3), np.float32), np.zeros((8, 8, 3), np.float32)), np.float32(0.0), np.float32(1.0)
    )
    assert wrap_user_env(env).reset()[0].max() in (127, 128)


@pytest.mark.parametrize(
    ("low", "high", "dtype"), [(0, 1000, np.uint16), (-128, 127, np.int8), (-5, 5, np.int32), (0, 1, bool)]
)
def test_remedy_for_other_whole_numbers_keeps_the_whole_range(low, high, dtype):
    picture = np.linspace(low, high, 64).reshape(8, 8).round().astype(dtype)
    still = Still(Box(low, high, (8, 8), dtype), picture)
    with pytest.raises(UserError) as refusal:
        wrap_user_env(still)
    remedy = str(refusal.value).split("for instance by ")[1]
    env = eval(remedy, {"gymnasium": gymnasium, "numpy": np, "env": still})
    frame = env.reset()[0]
    expected = (picture.astype(float) - low) * 255.0 / (high - low)
    assert frame.dtype == np.uint8 and np.abs(frame - expected).max() <= 1.0
    assert wrap_user_env(env).reset()[0].max() == 255


def test_frame_stack_of_gray_pictures_is_refused():
    stack = gymnasium.wrappers.FrameStackObservation(Still(bytes_box(20, 30), GRAY), 4)
    with pytest.raises(UserError, match="FrameStackObservation"):
        wrap_user_env(stack)


@pytest.mark.parametrize("value", [1.5, -0.1, float("nan")])
def test_floats_outside_the_declared_range_are_a_fault(value):
    picture = np.full((8, 8, 3), value, np.float32)
    with pytest.raises(EnvironmentFault, match=r"floats in \[0, 1\]"):
        wrap_user_env(Still(Box(0.0, 1.0, (8, 8, 3), np.float32), picture)).reset()


@pytest.mark.parametrize("size", FRAME_SIZES)
def test_frames_have_the_size_of_the_settings(size):
    env = wrap_user_env(Still(bytes_box(20, 30, 3), RGB), config=EnvConfig(frame_size=size))
    assert env.reset()[0].shape == env.observation_space.shape == env.render().shape == (size, size, 3)


@pytest.mark.parametrize(("size", "nearest"), [(60, 64), (80, 84), (100, 96), (224, 128)])
def test_other_frame_sizes_are_refused_with_the_nearest(size, nearest):
    with pytest.raises(
        ValueError, match=f"frame_size must be one of 64, 84, 96, 128, got {size}; the nearest is {nearest}"
    ):
        EnvConfig(frame_size=size)


CAMERAS = Dict({"left": bytes_box(20, 30, 3), "joints": Box(-1.0, 1.0, (4,)), "right": bytes_box(16, 16)})
VIEWS = {"left": RGB, "joints": np.zeros(4), "right": GRAY[:16, :16]}


def test_cameras_of_a_dict_are_stacked_in_order():
    env = wrap_user_env(Still(CAMERAS, VIEWS))
    assert env.spaces.cameras == 2 and env.observation_space.shape == (64, 64, 6)
    both, _ = env.reset()
    for place, name in enumerate(("left", "right")):
        alone = wrap_user_env(Still(CAMERAS, VIEWS), config=EnvConfig(cameras=(name,)))
        assert np.array_equal(alone.reset()[0], both[..., 3 * place : 3 * place + 3])
    turned = wrap_user_env(Still(CAMERAS, VIEWS), config=EnvConfig(cameras=("right", "left"))).reset()[0]
    assert np.array_equal(turned, np.concatenate([both[..., 3:], both[..., :3]], 2))
    assert env.render().shape == (64, 64, 3) and env.render_large(128).shape == (128, 128, 3)


def test_cameras_that_do_not_exist_are_refused():
    with pytest.raises(UserError, match="names 'top', which observation_space lacks; it has left, right"):
        accept_spaces(CAMERAS, ACTIONS, EnvConfig(cameras=("top",)))
    with pytest.raises(UserError, match=r"observation_space\['joints'\] must be a picture"):
        accept_spaces(CAMERAS, ACTIONS, EnvConfig(cameras=("joints",)))
    with pytest.raises(UserError, match="return a Dict with these keys"):
        accept_spaces(bytes_box(8, 8, 3), ACTIONS, EnvConfig(cameras=("left",)))
    with pytest.raises(ValueError, match="different ones"):
        EnvConfig(cameras=("left", "left"))


def test_more_pictures_than_an_agent_can_see_are_refused_until_some_are_named():
    many = Dict({f"view{number:02d}": bytes_box(8, 8, 3) for number in range(17)})
    with pytest.raises(UserError, match="holds 17 pictures, and at most 16 are allowed: name .* env.cameras"):
        accept_spaces(many, ACTIONS)
    assert accept_spaces(many, ACTIONS, EnvConfig(cameras=tuple(many)[:16])).spaces.cameras == 16


@pytest.mark.parametrize(("views", "message"), [({"left": RGB}, "got 'left'"), (RGB, "got ndarray")])
def test_observations_without_a_camera_are_a_fault(views, message):
    with pytest.raises(EnvironmentFault, match=message):
        wrap_user_env(Still(CAMERAS, views)).reset()
