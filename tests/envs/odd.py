"""Environments that gymnasium registers when this module is imported: good ones, and others that are odd in one way."""

import os
import sys
import time

import gymnasium
import numpy as np
from gymnasium.error import DependencyNotInstalled
from gymnasium.spaces import Box, Dict, Discrete, Text

PICTURE = Box(0, 255, (16, 16, 3), np.uint8)
STATE = Box(-np.inf, np.inf, (4,), np.float64)
ACTIONS = Box(-1.0, 1.0, (1,), np.float32)


class Slider(gymnasium.Env):
    """A bright column that the action moves; the reward is how near it is to the middle."""

    observation_space = PICTURE
    action_space = ACTIONS

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = self.np_random.uniform(-1.0, 1.0)
        return self.observe(), {}

    def step(self, action):
        self.place = float(np.clip(self.place + 0.3 * action[0], -1.0, 1.0))
        return self.observe(), 1.0 - abs(self.place), False, False, {}

    def observe(self):
        return self.draw(16, 16)

    def draw(self, height, width):
        picture = np.zeros((height, width, 3), np.uint8)
        column = round((width - 2) * (self.place + 1.0) / 2.0)
        picture[:, column : column + 2] = 255
        return picture


class State(Slider):
    """The same with a state as observation, and pictures of 20 x 40 that `render` draws and counts."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}
    observation_space = STATE

    def __init__(self, render_mode=None, brightness=255):
        self.render_mode, self.brightness, self.num_drawn = render_mode, brightness, 0

    def observe(self):
        return np.full(4, self.place)

    def render(self):
        self.num_drawn += 1
        return self.draw(20, 40) // 255 * np.uint8(self.brightness)


def with_spaces(observations=PICTURE, actions=ACTIONS):
    class Odd(Slider):
        observation_space, action_space = observations, actions

    return Odd


def with_step(change):
    class Odd(Slider):
        def step(self, action):
            return change(super().step(action))

    return Odd


class WithAlpha(Slider):
    observation_space = Box(0, 255, (16, 16, 4), np.uint8)

    def observe(self):
        return np.concatenate([super().observe(), np.full((16, 16, 1), 255, np.uint8)], axis=2)


class NoSeed(Slider):
    def reset(self):
        return super().reset()


class NoInfo(Slider):
    def reset(self, *, seed=None, options=None):
        return super().reset(seed=seed)[0]


class FailingReset(Slider):
    def reset(self, *, seed=None, options=None):
        raise ZeroDivisionError("no start")


class FailingStart(Slider):
    def __init__(self):
        raise RuntimeError("the motor does not answer")


class MissingLibrary(Slider):
    def __init__(self):
        import a_library_that_nobody_has  # noqa: F401


class NeedsSize(Slider):
    def __init__(self, size):
        self.size = size


class WrongStart(Slider):
    def __init__(self, size=3):
        int([size])


class NoSpace(gymnasium.Env):
    observation_space = PICTURE


class ExitAtStart(Slider):
    def __init__(self):
        os._exit(7)


class HangAtStart(Slider):
    def __init__(self):
        time.sleep(3600)


class NoPicture(State):
    def render(self):
        return None


class FloatPicture(State):
    def render(self):
        return self.draw(20, 40) / 255.0


class NoDrawingLibrary(State):
    def render(self):
        try:
            raise ModuleNotFoundError("No module named 'pygame'", name="pygame")
        except ModuleNotFoundError as error:
            raise DependencyNotInstalled("pygame is not installed, run `pip install gymnasium[classic]`") from error


class Constant(Slider):
    def observe(self):
        return np.arange(16 * 16 * 3, dtype=np.uint8).reshape(16, 16, 3)


class Unseeded(Slider):
    def reset(self, *, seed=None, options=None):
        self.place = float(np.random.default_rng().uniform(-1.0, 1.0))
        return np.random.default_rng().integers(0, 256, (16, 16, 3), dtype=np.uint8), {}


class Short(Slider):
    def step(self, action):
        picture, reward, *_ = super().step(action)
        return picture, reward, abs(self.place) > 0.9, False, {}


# name: (environment, settings, words of the one line that refuses it, the remedy among them)
REFUSED = {
    "FloatSpace": (
        with_spaces(Box(0.0, 1.0, (16, 16, 3), np.float32)),
        {},
        ["floats in [0, 1]", "divide brightness by 255"],
    ),
    "Grey": (with_spaces(Box(0, 255, (16, 16), np.uint8)), {}, ["(16, 16)", "declare in observation_space"]),
    "ChannelsFirst": (
        with_spaces(Box(0, 255, (3, 16, 16), np.uint8)),
        {},
        ["(3, 16, 16)", "declare in observation_space"],
    ),
    "StateOnly": (with_spaces(STATE), {}, ["observation_space", "AddRenderObservation"]),
    "StateWithRender": (State, {}, ["observation_space", "--env.pixels render"]),
    "DictWithoutPictures": (with_spaces(Dict({"joint": STATE})), {}, ["observation_space", "add one to the Dict"]),
    "TextSpace": (with_spaces(Text(8)), {}, ["observation_space", "Text"]),
    "Unbounded": (with_spaces(actions=Box(-np.inf, np.inf, (1,), np.float32)), {}, ["bounded", "TransformAction"]),
    "HugeActions": (with_spaces(actions=Box(-1e30, 1e30, (1,), np.float32)), {}, ["1e+30", "declare"]),
    "TextActions": (with_spaces(actions=Text(8)), {}, ["action", "Text"]),
    "NoSeed": (NoSeed, {}, ["reset must take both: def reset(self, *, seed=None, options=None)"]),
    "NoInfo": (NoInfo, {}, ["reset must return (observation, info)"]),
    "NoInfoAtAll": (with_step(lambda result: (*result[:4], None)), {}, ["must return a dict as info"]),
    "FourTuple": (
        with_step(lambda result: result[:4]),
        {},
        ["step (observation, reward, terminated, truncated, info)"],
    ),
    "NoneInfo": (with_step(lambda result: (*result[:4], None)), {}, ["a dict as info"]),
    "NanReward": (with_step(lambda result: (result[0], float("nan"), *result[2:])), {}, ["return a finite number"]),
    "TextReward": (with_step(lambda result: (result[0], "much", *result[2:])), {}, ["rewards that are numbers"]),
    "FloatFrame": (with_step(lambda result: (result[0] / 255.0, *result[1:])), {}, ["as np.uint8"]),
    "NanFrame": (with_step(lambda result: (result[0] * np.nan, *result[1:])), {}, ["not finite", "as np.uint8"]),
    "LargeNumbers": (
        with_step(lambda result: (result[0] * 3 + np.int64(999), *result[1:])),
        {},
        ["scale them to 0 to"],
    ),
    "OtherSize": (with_step(lambda result: (result[0][:8], *result[1:])), {}, ["declare in observation_space"]),
    "FailingReset": (FailingReset, {}, ["raised ZeroDivisionError: no start"]),
    "FailingStart": (FailingStart, {}, ["raised RuntimeError: the motor does not answer"]),
    "MissingLibrary": (MissingLibrary, {}, ["run: pip install a_library_that_nobody_has"]),
    "WrongArguments": (State, {"kwargs": '{"colour": 3}'}, ["--env-kwargs", "'colour'", "correct them"]),
    "MissingArgument": (NeedsSize, {}, ["missing 1 required positional argument: 'size'", "give it with --env-kwargs"]),
    "OtherArgument": (NeedsSize, {"kwargs": '{"colour": 3}'}, ["with --env-kwargs", "'colour'", "correct them"]),
    "WrongStart": (WrongStart, {}, ["raised TypeError: int() argument must be"]),
    "WrongStartWithArguments": (WrongStart, {"kwargs": '{"size": 4}'}, ["raised TypeError: int() argument must be"]),
    "NoRender": (Slider, {"pixels": "render"}, ["with --env.pixels render", "__init__ an argument render_mode"]),
    "NoRenderArgument": (
        NeedsSize,
        {"pixels": "render", "kwargs": '{"size": 3}'},
        ["with --env.pixels render", "__init__ an argument render_mode"],
    ),
    "NoSpace": (NoSpace, {}, ["the environment has no action_space", "set it in __init__"]),
    "NoNumbers": (with_spaces(actions=Box(-1.0, 1.0, (0,), np.float32)), {}, ["leaves a choice"]),
    "NoRenderMode": (Slider, {"pixels": "render", "kwargs": '{"render_mode": null}'}, ["render_mode"]),
    "NoPicture": (NoPicture, {"pixels": "render"}, ["render() must return pictures uint8", "NoneType"]),
    "NoDrawingLibrary": (
        NoDrawingLibrary,
        {"pixels": "render"},
        ["the environment needs pygame", "run: pip install 'latentplan[gymnasium]'"],
    ),
    "FloatPicture": (FloatPicture, {"pixels": "render"}, ["render() must return pictures uint8", "float64"]),
}
NOTED = {
    "Constant": (Constant, "have not changed"),
    "Unseeded": (Unseeded, "self.np_random"),
    "Short": (Short, "--planner.use_continues"),
    "LargeRewards": (with_step(lambda result: (result[0], 5000.0 * result[1], *result[2:])), "scale the rewards down"),
}
CRASHING = {
    "Exit": (with_step(lambda result: os._exit(7)), ["ended unexpectedly (exit code 7)", "look for os._exit"]),
    "SysExit": (with_step(lambda result: sys.exit(3)), ["raised SystemExit"]),
    "ExitAtStart": (ExitAtStart, ["ended unexpectedly (exit code 7)", "look for os._exit"]),
    "HangAtStart": (HangAtStart, ["has not answered for"]),
    "Hang": (with_step(lambda result: time.sleep(3600)), ["has not answered for 1 s", "--collection.step_timeout_s"]),
}

TWO_ACTIONS = with_spaces(actions=Box(-1.0, 1.0, (2,), np.float32))
TWO_PROBLEMS = with_spaces(STATE, Text(8))

gymnasium.register("Slider-v0", Slider, max_episode_steps=20)
SIX_CHOICES = with_spaces(actions=Discrete(6))


class TwoViews(Slider):
    observation_space = Dict({"left": PICTURE, "right": PICTURE})

    def observe(self):
        return {"left": super().observe(), "right": super().observe()}


gymnasium.register("odd/SixChoices-v0", SIX_CHOICES, max_episode_steps=20)
gymnasium.register("odd/TwoViews-v0", TwoViews, max_episode_steps=20)
gymnasium.register("WithAlpha-v0", WithAlpha, max_episode_steps=20)
gymnasium.register("odd/State-v0", State, max_episode_steps=20)
gymnasium.register("odd/TwoActions-v0", TWO_ACTIONS, max_episode_steps=20)
gymnasium.register("odd/TwoProblems-v0", TWO_PROBLEMS, max_episode_steps=20)
for name, (kind, *_) in {**REFUSED, **NOTED, **CRASHING}.items():
    gymnasium.register(f"odd/{name}-v0", kind, max_episode_steps=20)
