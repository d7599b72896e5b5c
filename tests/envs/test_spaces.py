"""Action spaces become numbers in [-1, 1] and back, or are refused in one line that names the remedy."""

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Text, Tuple
from gymnasium.wrappers import TransformAction

from latentplan.config import UserError
from latentplan.config.spaces import Spaces, category_values
from latentplan.envs import accept_spaces, wrap_user_env
from latentplan.envs.spaces import Actions

IMAGE = Box(0, 255, (64, 64, 3), np.uint8)
ARM = Box(np.array([[0.0, -4.0], [1.0, 0.0]], np.float32), np.array([[2.0, 4.0], [1.5, 9.0]], np.float32))
ACCEPTED = {
    "any bounds": (Box(-7.0, 3.0, (2,), np.float64), (0, 0), 2),
    "any shape": (ARM, (), 4),
    "one number": (Box(-1.0, 1.0, (), np.float32), (), 1),
    "integers": (Box(-3, 250, (2, 1), np.int16), (), 2),
    "discrete": (Discrete(4, start=-1), (4,), 1),
    "several choices": (MultiDiscrete([[2, 5], [1, 3]]), (2, 5, 3), 3),
    "bits": (MultiBinary((2, 2)), (2, 2, 2, 2), 4),
    "tuple of boxes": (Tuple((ARM, Box(0.0, 1.0, (1,), np.float32))), (), 5),
    "mixed": (Dict({"arm": ARM, "grip": Discrete(3), "more": Dict({"b": Box(0, 1, (1,))})}), (0, 0, 0, 0, 3, 0), 6),
}


class Recorder(gymnasium.Env):
    """Keeps the actions that it gets."""

    observation_space = IMAGE

    def __init__(self, action_space):
        self.action_space, self.actions = action_space, []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros((64, 64, 3), np.uint8), {}

    def step(self, action):
        self.actions.append(action)
        return np.zeros((64, 64, 3), np.uint8), 0.0, False, False, {}


@pytest.mark.parametrize("name", ACCEPTED)
def test_every_action_of_the_agent_lies_in_the_users_space(name):
    space, _, dim = ACCEPTED[name]
    env = wrap_user_env(Recorder(space))
    env.reset()
    assert env.action_space.shape == (dim,)
    rng = np.random.default_rng(0)
    for numbers in (*rng.uniform(-1.2, 1.2, (200, dim)), np.full(dim, -1.0), np.full(dim, 1.0)):
        env.step(numbers.astype(np.float32))
        assert space.contains(env.unwrapped._env.actions[-1]), env.unwrapped._env.actions[-1]


@pytest.mark.parametrize("name", ACCEPTED)
def test_choices_name_the_numbers_that_stand_for_categories(name):
    space, choices, _ = ACCEPTED[name]
    assert accept_spaces(IMAGE, space).spaces == Spaces(choices=choices if any(choices) else ())


def test_ends_of_the_interval_are_the_bounds_of_a_box():
    actions = Actions(ARM)
    assert (actions.value(np.full(4, -1.0)) == ARM.low).all()
    assert (actions.value(np.full(4, 1.0)) == ARM.high).all()
    assert actions.value(np.zeros(4)).dtype == np.float32


@pytest.mark.parametrize("num", [2, 3, 7, 1000])
def test_every_category_has_its_own_part_of_the_interval_and_all_are_equally_wide(num):
    actions = Actions(Discrete(num, start=5))
    assert [actions.value(np.array([value])) for value in category_values(num)] == list(range(5, 5 + num))
    places = np.linspace(-1.0, 1.0, 40 * num, endpoint=False) + 0.5 / (20 * num)
    drawn = np.array([actions.value(np.array([place])) for place in places])
    assert (np.bincount(drawn - 5, minlength=num) == 40).all()


def test_a_choice_of_one_category_needs_no_number():
    actions = Actions(Tuple((Discrete(1, start=3), Discrete(2))))
    assert actions.dim == 1 and actions.choices == (2,)
    assert actions.value(np.array([0.5])) == (3, 1)


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (Box(-np.inf, 1.0, (2,), np.float32), "must be bounded, .*TransformAction"),
        (Box(np.finfo(np.float32).min, np.finfo(np.float32).max, (2,), np.float32), "must be bounded"),
        (Dict({"arm": ARM, "leg": Box(-1.0, np.inf, (1,))}), r"action_space\['leg'\] must be bounded"),
        (Text(4), "got Text: convert it"),
        (Discrete(5000), "5000 categories, and at most 1024 .*MultiDiscrete"),
        (Discrete(1), "leaves a choice"),
        (Box(-1.0, 1.0, (0,), np.float32), "leaves a choice"),
        (Box(-1.0, 1.0, (9000,), np.float32), "1 to 4096 numbers"),
        (Box(0, 1, (2,), bool), "MultiBinary"),
        (Box(-1e30, 1e30, (2,), np.float32), r"ranges from -1e\+30 to 1e\+30, further than 1e\+06: declare"),
        (Dict({"arm": Box(-1e30, 1e30, (1,))}), r"action_space\['arm'\] ranges from"),
        (Tuple((ARM, Box(-1e30, 1e30, (1,)))), r"action_space\[1\] ranges from"),
        (Box(-(2**63), 2**63 - 1, (2,), np.int64), "action_space ranges from"),
        (Box(-(2**31), 2**31 - 1, (2,), np.int32), "action_space ranges from"),
    ],
)
def test_other_action_spaces_are_refused_with_the_remedy(space, message):
    for check in (lambda: wrap_user_env(Recorder(space)), lambda: accept_spaces(IMAGE, space)):
        with pytest.raises(UserError, match=message) as refusal:
            check()
        assert "\n" not in str(refusal.value)


def test_the_remedy_for_an_unbounded_box_works():
    unbounded = Recorder(Box(-np.inf, np.inf, (2,), np.float32))
    with pytest.raises(UserError) as refusal:
        wrap_user_env(unbounded)
    remedy = str(refusal.value).split("for instance by ")[1]
    assert wrap_user_env(eval(remedy, {"gymnasium": gymnasium, "env": unbounded})).action_space.shape == (2,)
    assert TransformAction.__name__ in remedy


@pytest.mark.parametrize("action", [np.zeros(2), np.array([np.nan]), 0.5])
def test_a_step_refuses_actions_of_another_shape_or_not_finite(action):
    env = wrap_user_env(Recorder(Discrete(3)))
    env.reset()
    with pytest.raises(ValueError, match="finite numbers"):
        env.step(action)
