"""Whatever the own environment of a suite returns is a fault of the environment, in this process and in another."""

from functools import partial

import numpy as np
import pytest

from latentplan.config import EnvConfig, EnvironmentFault
from latentplan.config.suites import SUITES, Suite
from latentplan.envs import make_vector_env
from latentplan.envs.process import LocalLane, ProcessLane
from latentplan.envs.vector import GuardedEnv, GuardedVectorEnv, Restarts, make_guarded_env
from tests.envs import faulty
from tests.envs.faulty import RESETS, RETURNS, SIZE, OfSuite

ACTION = np.zeros(1, np.float32)


@pytest.fixture
def make_lane(tmp_path):
    """Makes environments, each in this process or in one of its own; they are closed after the test."""
    made = []

    def make(kind, isolate=False):
        factory = partial(OfSuite, kind, tmp_path)
        made.append(ProcessLane(factory, 60.0) if isolate else LocalLane(factory))
        return made[-1]

    yield make
    for lane in made:
        lane.close(timeout=0.0)


CASES = [*((kind, False) for kind in RETURNS), ("nothing", True), ("info without frames", True), ("no frame", True)]


@pytest.mark.parametrize(("kind", "isolate"), CASES)
def test_wrong_return_of_a_step_truncates_the_episode(kind, isolate, make_lane):
    envs = GuardedVectorEnv([make_lane(kind, isolate)], Restarts(1))
    envs.reset(seed=5)
    for _ in range(2):
        before, *_ = envs.step(ACTION[None])
    with pytest.warns(RuntimeWarning, match="its episode is cut short"):
        frames, rewards, terminated, truncated, info = envs.step(ACTION[None])
    assert np.array_equal(frames, before) and rewards.tolist() == [0.0]
    assert (terminated.tolist(), truncated.tolist(), info["failed"].tolist()) == ([False], [True], [True])
    assert info["env_frames"].tolist() == [0] and envs.restarts.count == 1
    envs.reset(options={"reset_mask": truncated})
    _, rewards, _, _, info = envs.step(ACTION[None])
    assert (rewards.tolist(), info["env_frames"].tolist(), info["failed"].tolist()) == ([1.0], [1], [False])


@pytest.mark.parametrize(("kind", "isolate"), CASES)
def test_wrong_return_of_a_step_is_raised_by_a_single_environment(kind, isolate, make_lane):
    env = GuardedEnv(make_lane(kind, isolate), Restarts(1))
    env.reset(seed=5)
    for _ in range(2):
        env.step(ACTION)
    with pytest.raises(EnvironmentFault), pytest.warns(RuntimeWarning, match="its episode is cut short"):
        env.step(ACTION)
    env.reset(seed=5)
    assert env.step(ACTION)[1:] == (1.0, False, False, {"env_frames": 1})


@pytest.mark.parametrize("kind", RESETS)
def test_wrong_return_of_a_reset_is_a_fault(kind, make_lane):
    envs = GuardedVectorEnv([make_lane(kind)], Restarts(1))
    envs.reset(seed=5)
    with pytest.warns(RuntimeWarning, match="its episode is cut short"):
        frames, _ = envs.reset(seed=6)
    assert frames.shape == (1, SIZE, SIZE, 3) and envs.restarts.count == 1


@pytest.mark.parametrize("kind", RESETS)
def test_wrong_return_of_a_reset_is_raised_by_a_single_environment(kind, make_lane):
    env = GuardedEnv(make_lane(kind), Restarts(1))
    env.reset(seed=5)
    with pytest.raises(EnvironmentFault), pytest.warns(RuntimeWarning, match="its episode is cut short"):
        env.reset(seed=6)
    assert env.reset(seed=6)[0].shape == (SIZE, SIZE, 3)


def test_environment_of_a_registered_suite_is_guarded(tmp_path, monkeypatch):
    monkeypatch.setattr(faulty, "make", lambda config, seed: OfSuite(config.task, tmp_path), raising=False)
    tasks = ("nothing", "info without frames")
    monkeypatch.setitem(SUITES, "faulty", Suite("tests.envs.faulty:make", {"lamp": tasks}))
    for make, task in ((make_vector_env, tasks[0]), (make_guarded_env, tasks[1])):
        config = EnvConfig(suite="faulty", domain="lamp", task=task)
        envs = make(config, 1, 0) if make is make_vector_env else make(config, Restarts(0))
        envs.reset(seed=5)
        with pytest.raises(EnvironmentFault, match="the environment"):
            for _ in range(3):
                envs.step(ACTION[None] if make is make_vector_env else ACTION)
        for path in tmp_path.iterdir():
            path.unlink()


@pytest.mark.parametrize("isolate", [False, True])
def test_single_environment_needs_no_look_at_its_facts_first(isolate, make_lane):
    env = GuardedEnv(make_lane("never", isolate), Restarts(0))
    frame, info = env.reset(seed=5)
    assert frame.shape == env.observation_space.shape and info == {"env_frames": 0}
    assert env.action_space == OfSuite.action_space and env.metadata == OfSuite.metadata
    assert not hasattr(env, "render_large")
