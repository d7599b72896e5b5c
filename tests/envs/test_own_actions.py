"""Actions in [-1, 1] and the same actions in the units of an action space."""

import numpy as np
import pytest
from gymnasium import spaces

from latentplan.envs.spaces import Actions

BOX = spaces.Box(np.array([[-2.0, 0.0]]), np.array([[2.0, 10.0]]), dtype=np.float32)
SPACES = {
    "box": BOX,
    "whole numbers": spaces.Box(-3, 5, (2,), np.int64),
    "one value": spaces.Box(np.array([1.0, -1.0]), np.array([1.0, 1.0]), dtype=np.float64),
    "discrete": spaces.Discrete(3, start=-1),
    "many choices": spaces.MultiDiscrete([[2, 1], [4, 3]]),
    "bits": spaces.MultiBinary((2, 2)),
    "nested": spaces.Dict({"b": spaces.Tuple((spaces.Discrete(2), BOX)), "a": spaces.MultiBinary(2)}),
}


@pytest.fixture(params=SPACES.values(), ids=SPACES)
def space(request):
    space = request.param
    space.seed(0)
    return space


def stack(values):
    """Values of a space as Minari stores them: nested, with the axis of time first."""
    if isinstance(values[0], dict):
        return {key: stack([value[key] for value in values]) for key in values[0]}
    if isinstance(values[0], tuple):
        return tuple(stack([value[place] for value in values]) for place in range(len(values[0])))
    return np.stack(values)


def test_from_own_is_the_inverse_of_to_own(space):
    actions = Actions(space)
    own = actions.to_own(np.random.default_rng(0).uniform(-1, 1, (50, actions.dim)))
    assert own.shape == (50, actions.bounds.shape[1])
    assert (own >= actions.bounds[0]).all() and (own <= actions.bounds[1]).all()
    again = actions.from_own(own)
    assert again.dtype == np.float32 and np.abs(again).max() <= 1.0
    assert np.allclose(actions.to_own(again.astype(np.float64)), own, atol=1e-5)


def test_to_own_gives_the_numbers_of_the_value_that_the_environment_takes(space):
    actions = Actions(space)
    drawn = np.random.default_rng(1).uniform(-1, 1, (20, actions.dim))
    values = [actions.value(action) for action in drawn]
    assert all(space.contains(value) for value in values)
    assert np.allclose(actions.flatten(stack(values)), actions.to_own(drawn), atol=1e-5)


def test_values_of_the_space_return_from_the_actions_that_stand_for_them(space):
    actions, values = Actions(space), [space.sample() for _ in range(30)]
    own = actions.flatten(stack(values))
    back = [actions.value(action) for action in actions.from_own(own).astype(np.float64)]
    assert np.allclose(actions.flatten(stack(back)), own, atol=1e-5)


@pytest.mark.parametrize("values", [np.zeros((3, 2)), {"a": np.zeros((3, 2))}, {"a": np.zeros((3, 2)), "c": ()}])
def test_flatten_refuses_values_of_another_form(values):
    with pytest.raises(ValueError, match="no values of Dict"):
        Actions(SPACES["nested"]).flatten(values)
