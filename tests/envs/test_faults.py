"""An environment that fails loses one episode, not the run; what it returns is checked."""

import multiprocessing
import warnings
from functools import partial

import numpy as np
import pytest

from latentplan.config import EnvConfig, EnvironmentFault, UserError
from latentplan.envs import make_vector_env
from latentplan.envs.faults import FrameCheck, check_picture, check_reward
from latentplan.envs.vector import Restarts, make_guarded_env
from tests.envs.faulty import CRASHES, FAULTS, Faulty

CONFIG = EnvConfig(action_repeat=1)
SHAPE = (4, 4, 3)
RIGHT = np.arange(48, dtype=np.uint8).reshape(SHAPE)


@pytest.fixture
def make(tmp_path):
    """Makes environments, the first of which fails; they are closed after the test."""
    made = []

    def build(kind, times=1, budget=2, num_envs=1, **options):
        folder = tmp_path / kind
        folder.mkdir()
        factory = partial(Faulty, kind, folder, times)
        envs = make_vector_env(CONFIG, num_envs, 0, factory, restarts=Restarts(budget), **options)
        made.append(envs)
        return envs

    yield build
    for envs in made:
        envs.close(timeout=0.0)


def play_until_fault(envs, steps=3):
    """Frames before the step that fails, and the result of that step."""
    frames, _ = envs.reset(seed=5)
    for _ in range(steps):
        before, (frames, *outcome) = frames, envs.step(np.zeros((envs.num_envs, 1), np.float32))
    return before, frames, *outcome


def assert_survives(envs):
    with pytest.warns(RuntimeWarning, match="its episode is cut short"):
        before, frames, rewards, terminated, truncated, info = play_until_fault(envs)
    assert np.array_equal(frames, before) and rewards.tolist() == [0.0]
    assert (terminated.tolist(), truncated.tolist(), info["failed"].tolist()) == ([False], [True], [True])
    assert info["env_frames"].tolist() == [0] and envs.restarts.count == 1
    envs.reset(options={"reset_mask": truncated})
    for _ in range(4):
        _, rewards, _, truncated, info = envs.step(np.zeros((1, 1), np.float32))
        assert rewards.tolist() == [1.0] and not truncated.any() and not info["failed"].any()


@pytest.mark.parametrize("kind", [kind for kind in FAULTS if kind not in CRASHES])
def test_fault_truncates_the_episode_and_the_environment_is_made_anew(kind, make):
    assert_survives(make(kind))


@pytest.mark.parametrize("kind", ["exception", "nan frame", "no reward", *CRASHES])
def test_fault_in_a_process_of_its_own_truncates_the_episode_and_the_process_is_replaced(kind, make):
    assert_survives(make(kind, isolate=True, step_timeout_s=0.5 if kind == "hang" else 60.0))
    assert len(multiprocessing.active_children()) == 1


def test_fault_of_one_environment_leaves_the_others_alone(make):
    envs = make("exit", num_envs=2)
    with pytest.warns(RuntimeWarning, match="ended unexpectedly"):
        _, _, rewards, _, truncated, info = play_until_fault(envs)
    assert sorted(info["failed"]) == [False, True] == sorted(truncated) and sorted(rewards) == [0.0, 1.0]
    frames, _ = envs.reset(options={"reset_mask": truncated})
    assert frames.shape == (2, 64, 64, 3)
    _, rewards, *_, info = envs.step(np.zeros((2, 1), np.float32))
    assert rewards.tolist() == [1.0, 1.0] and not info["failed"].any()


def test_reset_that_fails_is_repeated_with_a_seed_that_its_seed_determines(make, tmp_path):
    envs, plain = make("reset", times=2), make("never")
    with pytest.warns(RuntimeWarning, match="no start"):
        frames, _ = envs.reset(seed=5)
    assert envs.restarts.count == 2
    assert not np.array_equal(frames, plain.reset(seed=5)[0])
    for count in ("0", "1"):
        (tmp_path / "reset" / count).unlink()
    envs.restarts.budget = 4
    with pytest.warns(RuntimeWarning, match="no start"):
        assert np.array_equal(envs.reset(seed=5)[0], frames)


def test_reset_that_fails_with_one_seed_alone_is_survived(tmp_path):
    class Picky(Faulty):
        def reset(self, *, seed=None, options=None):
            if seed == 5:
                raise ZeroDivisionError("no start with this seed")
            return super().reset(seed=seed, options=options)

    envs = make_vector_env(CONFIG, 1, 0, partial(Picky, "never", tmp_path), restarts=Restarts(1))
    with pytest.warns(RuntimeWarning, match="no start with this seed"):
        envs.reset(seed=5)
    assert envs.restarts.count == 1
    envs.close()


def test_environment_that_was_made_anew_does_not_repeat_its_first_episode(make):
    envs = make("exception", times=1)
    first, _ = envs.reset()
    with pytest.warns(RuntimeWarning):
        for _ in range(3):
            _, _, _, truncated, _ = envs.step(np.zeros((1, 1), np.float32))
    assert not np.array_equal(envs.reset(options={"reset_mask": truncated})[0], first)


@pytest.mark.parametrize("isolate", [False, True])
def test_fault_beyond_the_budget_has_the_environments_own_traceback(isolate, make):
    envs = make("exception", times=99, budget=0, isolate=isolate)
    with pytest.raises(EnvironmentFault, match="the lamp is out after 0 restarts") as fault:
        play_until_fault(envs)
    lines = fault.value.origin.splitlines()
    assert "faulty.py" in lines[1] and lines[-1] == "ZeroDivisionError: the lamp is out"
    assert fault.value.__notes__ == [fault.value.origin]


def test_mistake_of_the_user_is_not_a_fault():
    with pytest.raises(UserError, match="must return a gymnasium.Env") as error:
        make_vector_env(CONFIG, 1, 0, dict, isolate=True)
    assert not isinstance(error.value, EnvironmentFault)
    with pytest.raises(EnvironmentFault, match="raised NameError: name 'lamp'"):
        make_vector_env(CONFIG, 1, 0, lambda: lamp, isolate=True)  # noqa: F821
    assert multiprocessing.active_children() == []


def test_environments_that_hang_are_closed_in_time(make):
    envs = make("hang", isolate=True)
    envs.reset(seed=5)
    for _ in range(2):
        envs.step(np.zeros((1, 1), np.float32))
    envs.lanes[0].ask("step", np.zeros(1, np.float32))
    envs.close(timeout=0.2)
    assert multiprocessing.active_children() == []


@pytest.mark.parametrize("isolate", [False, True])
def test_guarded_env_raises_the_fault_and_plays_on(isolate, tmp_path):
    env = make_guarded_env(CONFIG, Restarts(1), partial(Faulty, "exception", tmp_path), isolate)
    assert env.facts["decisions_per_episode"] is None and env.render_large(80).shape == (80, 80, 3)
    env.reset(seed=1)
    with pytest.raises(EnvironmentFault, match="the lamp is out"), pytest.warns(RuntimeWarning):
        for _ in range(3):
            env.step(np.zeros(1, np.float32))
    assert env.reset(seed=1)[0].shape == (64, 64, 3)
    assert env.step(np.zeros(1, np.float32))[1] == 1.0
    env.close()


@pytest.mark.parametrize("picture", [RIGHT, RIGHT.astype(np.int64), RIGHT.tolist()])
def test_check_picture_returns_a_new_array(picture):
    checked = check_picture(picture, SHAPE)
    assert checked.dtype == np.uint8 and np.array_equal(checked, RIGHT) and checked is not picture


@pytest.mark.parametrize(
    ("picture", "words"),
    [
        (None, "got None"),
        (RIGHT / 255.0, "float64 with values 0 to 0.18"),
        (np.full(SHAPE, np.nan), "not finite"),
        (np.full(SHAPE, 999), "values 999 to 999"),
        (np.full(SHAPE, -1), "values -1 to -1"),
        (RIGHT > 3, "got bool"),
        (RIGHT[:2], r"shape \(2, 4, 3\)"),
        ("x" * 10**6, "got 'xxx"),
    ],
)
def test_check_picture_says_what_is_wrong(picture, words):
    with pytest.raises(EnvironmentFault, match=words) as fault:
        check_picture(picture, SHAPE)
    assert len(str(fault.value)) < 200


@pytest.mark.parametrize("reward", [1, 0.5, np.float32(0.25), np.array(2.0), True])
def test_check_reward_returns_a_number(reward):
    assert check_reward(reward) == float(reward)


@pytest.mark.parametrize("reward", [None, "much", np.nan, -np.inf, 1e39, 10**400, [1.0], np.ones(2)])
def test_check_reward_refuses_what_replay_cannot_hold(reward):
    with pytest.raises(EnvironmentFault, match="reward.*return (a finite|one) number"):
        check_reward(reward)


@pytest.mark.parametrize(
    ("picture", "decisions", "words"),
    [
        (np.zeros(SHAPE, np.uint8), 10, "are black"),
        (np.full(SHAPE, 9, np.uint8), 10, "are of one colour"),
        (RIGHT, 101, "have not changed for 100 decisions"),
    ],
)
def test_frame_check_warns_once_of_frames_that_show_nothing(picture, decisions, words):
    check, frames = FrameCheck(2), np.stack([RIGHT, picture])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for index in range(decisions - 1):
            frames[0, 0, 0] = index  # the first environment moves
            check(frames)
    with pytest.warns(RuntimeWarning, match=words):
        check(frames)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check(frames)


def test_frame_check_accepts_frames_that_change_now_and_then():
    check = FrameCheck(1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for step in range(300):
            check(np.where(step % 90 == 0, 0, RIGHT)[None].astype(np.uint8))
