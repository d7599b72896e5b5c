"""Tasks of dm_control as environments of frames: determinism, spaces, time limits, rendering, errors."""

import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env

from latentplan.config import EnvConfig, UserError
from latentplan.envs import default_task, make_env


def config(**changes):
    return EnvConfig(**{"domain": "cartpole", "render_quality": "fastest", "action_repeat": 8, **changes})


@pytest.fixture(scope="module")
def env():
    env = make_env(config(), seed=0)
    yield env
    env.close()


def play(env, seed, num_decisions=5):
    """Frames, rewards and true states of a few random decisions from a seeded start."""
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (num_decisions, *env.action_space.shape))
    frame, _ = env.reset(seed=seed)
    frames, rewards, states = [frame], [], [env.true_state()]
    for action in actions:
        frame, reward, *_ = env.step(action)
        frames.append(frame)
        rewards.append(reward)
        states.append(env.true_state())
    return np.stack(frames), np.array(rewards), np.stack(states)


def test_episode_depends_on_its_seed_alone(env):
    first, other, again = play(env, 5), play(env, 6), play(env, 5)
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first[2], other[2])


def test_reset_continues_the_random_stream_without_a_seed(env):
    env.reset(seed=3)
    states = []
    for _ in range(2):
        env.reset()
        states.append(env.true_state())
    env.reset(seed=3)
    env.reset()
    assert not np.array_equal(states[0], states[1])
    assert np.array_equal(states[0], env.true_state())


def test_make_env_seeds_the_first_reset(env):
    other = make_env(config(), seed=11)
    other.reset()
    env.reset(seed=11)
    assert np.array_equal(other.true_state(), env.true_state())
    other.close()


def test_frames_are_independent_of_other_environments(env):
    alone, _, _ = play(env, 5)
    other = make_env(config(domain="pendulum"), seed=0)
    other.reset()
    frames = [env.reset(seed=5)[0]]
    for action in np.random.default_rng(0).uniform(-1.0, 1.0, (5, 1)):
        other.step(action)
        frames.append(env.step(action)[0])
    other.close()
    assert np.array_equal(alone, np.stack(frames))


def test_frames_are_new_arrays(env):
    frame, _ = env.reset(seed=0)
    copy = frame.copy()
    for _ in range(5):
        env.step(np.ones(1))
    assert np.array_equal(frame, copy)


def test_spaces_are_uint8_frames_and_bounded_float32_actions(env):
    assert env.observation_space.shape == (64, 64, 3)
    assert env.observation_space.dtype == np.uint8
    assert env.action_space.dtype == np.float32
    assert (env.action_space.low == -1.0).all() and (env.action_space.high == 1.0).all()


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_suite_env_passes_gymnasiums_checker(env):
    check_env(env, skip_render_check=True)


def test_step_sums_the_rewards_of_its_control_steps(env):
    single = make_env(config(action_repeat=1), seed=0)
    env.reset(seed=2)
    single.reset(seed=2)
    action = np.array([0.7])
    frame, reward, *_ = env.step(action)
    steps = [single.step(action) for _ in range(8)]
    assert reward == pytest.approx(sum(step[1] for step in steps), abs=1e-12)
    assert np.array_equal(frame, steps[-1][0])
    assert np.array_equal(env.true_state(), single.true_state())
    single.close()


@pytest.mark.parametrize(("action_repeat", "decisions", "last"), [(8, 125, 8), (300, 4, 100)])
def test_step_truncates_after_a_thousand_control_steps(action_repeat, decisions, last):
    env = make_env(config(action_repeat=action_repeat), seed=0)
    env.reset()
    taken, total, ended = [], 0.0, False
    while not ended:
        _, reward, terminated, ended, info = env.step(np.zeros(1))
        assert not terminated
        taken.append(info["env_frames"])
        total += reward
    assert len(taken) == decisions == env.unwrapped.decisions_per_episode
    assert (sum(taken), taken[-1]) == (1000, last)
    with pytest.raises(ResetNeeded):
        env.step(np.zeros(1))
    env.close()


def test_step_terminates_when_the_task_ends():
    env = make_env(config(domain="lqr", action_repeat=1), seed=0)
    env.reset()
    with env.physics.reset_context():
        env.physics.data.qpos[:] = 0.0  # the goal of the regulator
    _, _, terminated, truncated, _ = env.step(np.zeros(env.action_space.shape))
    env.close()
    assert terminated and not truncated


def test_step_clips_actions_to_the_bounds(env):
    states = []
    for value in (1.0, 7.0):
        env.reset(seed=4)
        env.step(np.array([value]))
        states.append(env.true_state())
    assert np.array_equal(*states)


@pytest.mark.parametrize(("domain", "largest"), [("lqr", 1.0), ("quadruped", [1.0, 1.1, 0.8] * 4)])
def test_step_scales_actions_to_the_control_range_or_1_without_one(domain, largest):
    env = make_env(config(domain=domain, action_repeat=1), seed=0)
    env.reset(seed=0)
    env.step(np.ones(env.action_space.shape))
    controls = env.physics.control()
    env.close()
    assert controls == pytest.approx(np.broadcast_to(largest, controls.shape))


@pytest.mark.parametrize("action", [np.zeros(2), np.array([np.nan])])
def test_step_refuses_actions_of_another_shape_or_not_finite(env, action):
    env.reset(seed=0)
    with pytest.raises(ValueError, match="action"):
        env.step(action)


def test_exact_frame_equals_dm_controls_rendering():
    env = make_env(config(render_quality="exact"), seed=0)
    frame, _ = env.reset()
    expected = env.physics.render(64, 64, camera_id=0)
    env.close()
    assert np.array_equal(frame, expected)


@pytest.mark.parametrize("domain", ["walker", "reacher"])
def test_slices_change_outlines_of_the_agents_pictures_only(domain):
    def draw(quality, slices, size):
        env = make_env(config(domain=domain, render_quality=quality, render_slices=slices), seed=0)
        env.reset()
        frame = env.render_large(size)
        env.close()
        return frame.astype(int)

    exact, smooth, default, coarse = (
        draw(quality, slices, 64) for quality, slices in (("exact", 28), ("fast", 28), ("fast", 14), ("fast", 4))
    )
    changes = [np.abs(frame - exact).mean() for frame in (smooth, default, coarse)]
    assert changes == sorted(changes) and changes[1] < 1.0 < np.abs(coarse - smooth).max()
    assert np.array_equal(draw("exact", 4, 64), exact)
    assert np.array_equal(draw("fast", 4, 128), draw("fast", 28, 128))  # a film


@pytest.mark.parametrize("domain", ["walker", "cheetah"])
def test_endless_floor_changes_only_frames_behind_the_start(domain):
    """The suite draws no floor behind the start: frames differ behind the start, and are equal ahead of it."""
    envs = [make_env(config(domain=domain, floor=floor), seed=0) for floor in ("suite", "endless")]
    differences = {}
    for place in (-8.0, 8.0):
        for env in envs:
            env.reset(seed=1)
            env.physics.named.data.qpos["rootx"] = place
            env.physics.forward()
        differences[place] = np.abs(envs[0].render().astype(int) - envs[1].render()).max()
    states = [(env.step(np.ones(6)), env.true_state())[1] for env in envs]
    for env in envs:
        env.close()
    assert differences[-8.0] > 20
    assert differences[8.0] <= 1
    assert np.array_equal(*states)


def test_render_large_shows_the_same_view(env):
    frame, _ = env.reset(seed=0)
    large = env.unwrapped.render_large(256)
    assert large.shape == (256, 256, 3)
    means = large.reshape(64, 4, 64, 4, 3).mean(axis=(1, 3))
    assert np.abs(means - frame).mean() < 4.0  # edges fall differently on 16 pixels than on one
    assert np.array_equal(env.render(), frame)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"domain": "cartpol"}, r"unknown domain 'cartpol'; available: acrobot, .* Did you mean 'cartpole'\?"),
        ({"task": "cheetah-run"}, r"unknown task of cartpole .* Did you mean --domain cheetah --task run\?"),
        ({"domain": "walker-walk"}, r"unknown domain 'walker-walk'; .* Did you mean --domain walker --task walk\?"),
        ({"task": "swing"}, r"unknown task of cartpole 'swing'; available: balance, .* Did you mean 'swingup'\?"),
        ({"camera": 9}, r"camera 9 does not exist; cartpole has 2 cameras"),
    ],
)
def test_make_env_names_the_nearest_choice_for_unknown_names(changes, message):
    with pytest.raises(UserError, match=message):
        make_env(config(**changes))


def test_default_task_exists_in_every_domain():
    from dm_control import suite

    for domain, tasks in suite.TASKS_BY_DOMAIN.items():
        assert default_task(domain) in tasks
    with pytest.raises(UserError, match="Did you mean 'walker'"):
        default_task("walkr")


def test_cameras_are_stacked_and_each_looks_as_alone():
    both = make_env(EnvConfig(domain="cartpole", cameras=("1", "0"), frame_size=84), seed=0)
    frame, _ = both.reset(seed=3)
    assert frame.shape == both.observation_space.shape == (84, 84, 6) and both.spaces.cameras == 2
    for place, camera in enumerate((1, 0)):
        alone = make_env(EnvConfig(domain="cartpole", camera=camera, frame_size=84), seed=0)
        assert np.array_equal(alone.reset(seed=3)[0], frame[..., 3 * place : 3 * place + 3])
    assert np.array_equal(both.render(), frame[..., :3])
    assert both.step(np.zeros(1))[0].shape == (84, 84, 6)


@pytest.mark.parametrize(("camera", "message"), [("9", "camera 9 does not exist"), ("left", "takes camera ids")])
def test_cameras_that_do_not_exist_are_refused(camera, message):
    with pytest.raises(UserError, match=message):
        make_env(EnvConfig(domain="cartpole", cameras=("0", camera)))
