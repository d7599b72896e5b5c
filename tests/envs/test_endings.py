"""How environments end: their simulators are closed, children of their own are allowed, and episodes have a limit."""

import multiprocessing
import sys
import time
from functools import partial
from pathlib import Path

import cv2
import gymnasium
import numpy as np
import pytest

from latentplan.config import EnvConfig, EnvironmentFault, UserError
from latentplan.envs import make_vector_env, wrap_user_env
from latentplan.envs.faults import check_end
from latentplan.envs.spaces import resize
from latentplan.envs.user import MAX_DECISIONS, make_from
from latentplan.envs.vector import Restarts, make_guarded_env

CONFIG = EnvConfig(action_repeat=1)
PICTURE = gymnasium.spaces.Box(0, 255, (8, 8, 3), np.uint8)


class Plain(gymnasium.Env):
    """Shows a black picture for ever; `kind` says what is odd about it.

    Each object leaves a file when it is made, and another one when it is closed.
    """

    observation_space, action_space = PICTURE, gymnasium.spaces.Box(-1.0, 1.0, (1,))

    def __init__(self, kind="", folder=None):
        self.kind, self.folder, self.steps = kind, folder, 0
        self.note("made")
        if kind == "child":
            self.simulator = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(60.0,))
            self.simulator.start()
        if kind.startswith("limit"):
            self._max_episode_steps = float(kind.split()[1])

    def note(self, word):
        if self.folder is not None:
            (Path(self.folder) / f"{word} {id(self)} {time.monotonic_ns()}").touch()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros((8, 8, 3), np.uint8), {}

    def step(self, action):
        self.steps += 1
        if self.kind == "raises" and self.steps == 2:
            raise RuntimeError("it broke")
        if self.kind == "quits" and self.steps == 2:
            sys.exit()
        return np.zeros((8, 8, 3), np.uint8), 1.0, False, False, {}

    def close(self):
        self.note("closed")
        if self.kind == "child":
            self.simulator.terminate()
            self.simulator.join()


def count(folder, word):
    return len(list(folder.glob(f"{word} *")))


@pytest.mark.parametrize("isolate", [False, True])
def test_environment_that_failed_is_closed_before_another_is_made(isolate, tmp_path):
    envs = make_vector_env(CONFIG, 1, 0, partial(Plain, "raises", tmp_path), restarts=Restarts(1), isolate=isolate)
    envs.reset(seed=0)
    with pytest.warns(RuntimeWarning, match="it broke"):
        for _ in range(2):
            envs.step(np.zeros((1, 1), np.float32))
    envs.reset(options={"reset_mask": np.ones(1, bool)})
    envs.close()
    assert (count(tmp_path, "made"), count(tmp_path, "closed")) == (2, 2)


def test_environment_may_have_processes_of_its_own():
    env = make_guarded_env(CONFIG, make_env=partial(Plain, "child"), isolate=True)
    env.reset(seed=0)
    env.step(np.zeros(1, np.float32))
    env.close()


SCRIPT = """
import gymnasium, numpy
from latentplan.config import EnvConfig
from latentplan.envs.vector import make_guarded_env
from tests.envs.test_endings import Plain

class Torque(gymnasium.spaces.Box):
    pass

class Robot(Plain):
    action_space = Torque(-1.0, 1.0, (1,))

if __name__ == "__main__":
    env = make_guarded_env(EnvConfig(action_repeat=1), make_env=Robot, isolate=True)
    print(type(env.facts["interface"].action_space).__name__)
    env.close()
"""


def test_space_of_a_class_that_only_the_script_has_reaches_the_learner(run_python, tmp_path):
    (tmp_path / "script.py").write_text(SCRIPT)
    done = run_python(tmp_path / "script.py")
    assert done.stdout == "Torque\n", done.stderr


@pytest.mark.parametrize("isolate", [False, True])
def test_exit_in_an_environment_is_a_fault(isolate):
    env = make_guarded_env(CONFIG, make_env=partial(Plain, "quits"), isolate=isolate)
    env.reset(seed=0)
    env.step(np.zeros(1, np.float32))
    with pytest.raises(EnvironmentFault, match="SystemExit"):
        env.step(np.zeros(1, np.float32))
    env.close()


@pytest.mark.parametrize(("limit", "decisions"), [("100", 50), ("inf", MAX_DECISIONS), ("-1", MAX_DECISIONS)])
def test_limit_that_an_environment_names_and_does_not_keep_ends_the_episode(limit, decisions):
    env = wrap_user_env(Plain(f"limit {limit}"), 2)
    env.reset(seed=0)
    for decision in range(1, decisions + 1):
        *_, truncated, _ = env.step(np.zeros(1, np.float32))
        assert truncated == (decision == decisions)


def test_factory_that_returns_the_same_environment_twice_is_refused():
    one = Plain()
    makers = [make_from(lambda: one) for _ in range(2)]  # of collection and evaluation
    makers[0](CONFIG)
    with pytest.raises(UserError, match="a new environment at each call"):
        makers[1](CONFIG)


@pytest.mark.parametrize("end", [True, np.bool_(True), 1, [True], np.array([True]), np.array(1)])
def test_end_is_one_truth(end):
    assert check_end(end, "terminated") is True


@pytest.mark.parametrize("end", [False, np.bool_(False), 0, [False], np.array([False])])
def test_end_that_is_false_in_a_list_is_false(end):
    assert check_end(end, "terminated") is False


@pytest.mark.parametrize("end", [None, "False", "", (), [False, False], 0.5, {}])
def test_end_that_is_no_truth_is_a_fault(end):
    with pytest.raises(EnvironmentFault, match="must return terminated as True or False"):
        check_end(end, "terminated")


@pytest.mark.parametrize("shape", [(60, 640), (640, 60), (640, 640), (16, 1024), (64, 640)])
def test_thin_things_stay_visible_in_a_picture_of_any_shape(shape):
    picture = np.zeros((*shape, 3), np.uint8)
    height, width = shape
    cv2.line(picture, (width // 3, 0), (width // 3, height), (255, 255, 255), max(2, width // 300))
    cv2.line(picture, (0, height // 3), (width, height // 3), (255, 255, 255), max(2, height // 300))
    small = resize(picture, 64)
    assert small.shape == (64, 64, 3) and small[50].max() > 20 and small[:, 50].max() > 20
