"""An environment that fails in a given way; processes that make it import nothing else from the tests."""

import os
import sys
import time
from pathlib import Path

import gymnasium
import numpy as np

SIZE = 16


class Faulty(gymnasium.Env):
    """Counts its steps in the brightness of its frames; fails at the third step, `times` times over all processes.

    Args:
        kind: How it fails; a name in `FAULTS`, or `reset`.
        folder: Folder that counts the failures.
        times: Number of failures.
    """

    observation_space = gymnasium.spaces.Box(0, 255, (SIZE, SIZE, 3), np.uint8)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, kind, folder, times=1):
        self.kind, self.folder, self.times = kind, Path(folder), times

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if self.kind == "reset" and self.is_due():
            raise ZeroDivisionError("no start")
        self.steps, self.start = 0, int(self.np_random.integers(0, 100))
        return self.picture(), {}

    def step(self, action):
        self.steps += 1
        result = self.picture(), 1.0, False, self.steps == 10, {}
        if self.steps == 3 and self.kind != "reset" and self.is_due():
            return FAULTS[self.kind](result)
        return result

    def picture(self):
        picture = np.full((SIZE, SIZE, 3), self.start, np.uint8)
        picture[: self.steps + 1] = 255
        return picture

    def is_due(self):
        for count in range(self.times):
            try:
                (self.folder / str(count)).touch(exist_ok=False)  # two processes may arrive at the same time
                return True
            except FileExistsError:
                continue
        return False


def divide(result):
    raise ZeroDivisionError("the lamp is out")


def hang(result):
    time.sleep(3600)


def with_frame(change):
    return lambda result: (change(result[0]), *result[1:])


def with_reward(reward):
    return lambda result: (result[0], reward, *result[2:])


FAULTS = {
    "exception": divide,
    "exit": lambda result: os._exit(7),
    "sys.exit": lambda result: sys.exit(3),
    "hang": hang,
    "nothing": lambda result: None,
    "no frame": with_frame(lambda frame: None),
    "float frame": with_frame(lambda frame: frame / 255.0),
    "nan frame": with_frame(lambda frame: np.full(frame.shape, np.nan)),
    "large numbers": with_frame(lambda frame: np.full(frame.shape, 999)),
    "negative numbers": with_frame(lambda frame: np.full(frame.shape, -1)),
    "other size": with_frame(lambda frame: frame[:8]),
    "grey": with_frame(lambda frame: frame[..., 0]),
    "text": with_frame(lambda frame: "a picture"),
    "ragged": with_frame(lambda frame: [[1], [1, 2]]),
    "nan reward": with_reward(float("nan")),
    "infinite reward": with_reward(float("inf")),
    "reward beyond float32": with_reward(1e39),
    "no reward": with_reward(None),
    "reward of text": with_reward("much"),
    "rewards": with_reward(np.ones(3)),
}
CRASHES = ("exit", "sys.exit", "hang")  # only noticed in a process of its own


class OfSuite(Faulty):
    """The same as a suite's factory makes it, with nothing between it and the trainer; `kind` is a name in `RETURNS`.

    A kind in `RESETS` fails at the second reset instead.
    """

    def reset(self, *, seed=None, options=None):
        picture, _ = super().reset(seed=seed)
        result = picture, {"env_frames": 0}
        self.resets = getattr(self, "resets", 0) + 1
        return RESETS[self.kind](result) if self.kind in RESETS and self.resets == 2 and self.is_due() else result

    def step(self, action):
        self.steps += 1
        result = self.picture(), 1.0, False, self.steps == 10, {"env_frames": 1}
        return RETURNS[self.kind](result) if self.kind in RETURNS and self.steps == 3 and self.is_due() else result


RETURNS = {
    **{kind: FAULTS[kind] for kind in ("exception", "nothing", "no frame", "float frame", "nan reward", "no reward")},
    "four values": lambda result: result[:4],
    "old style": lambda result: (*result[:2], result[2], result[4]),
    "number": lambda result: 3,
    "no info": lambda result: (*result[:4], None),
    "info without frames": lambda result: (*result[:4], {}),
    "frames of text": lambda result: (*result[:4], {"env_frames": "many"}),
    "several ends": lambda result: (*result[:2], np.zeros(2, bool), *result[3:]),
}
RESETS = {
    "reset of nothing": lambda result: None,
    "reset without info": lambda result: result[0],
    "reset of text": lambda result: ("a picture", result[1]),
    "reset with wrong info": lambda result: (result[0], 3),
}
