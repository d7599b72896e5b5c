"""An agent plays only where actions and observations have the form that it knows."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete, Tuple

from latentplan.config import EnvConfig, UserError
from latentplan.config.spaces import Spaces
from latentplan.envs import make_env, wrap_user_env
from latentplan.envs.vector import make_guarded_env
from latentplan.evaluation.compatibility import refuse_other_spaces

PICTURE = Box(0, 255, (16, 16, 3), np.uint8)


class Mixed(gymnasium.Env):
    """Two cameras, a vector, and actions of a continuous number and a choice."""

    observation_space = Dict({"left": PICTURE, "right": PICTURE, "joints": Box(-1.0, 1.0, (5,))})
    action_space = Tuple((Box(-1.0, 1.0, (1,)), Discrete(3)))


CONFIG = EnvConfig(vectors=("joints",), frame_size=84)
OWN = Spaces(choices=(0, 3), frame_size=84, cameras=2, vector_dim=5)


def test_environment_of_the_same_form_is_accepted_whoever_made_it():
    refuse_other_spaces(wrap_user_env(Mixed(), config=CONFIG), "mixed", 2, OWN)
    guarded = make_guarded_env(CONFIG, make_env=Mixed)
    refuse_other_spaces(guarded, "mixed", 2, OWN)
    refuse_other_spaces(make_env(EnvConfig(domain="cartpole")), "cartpole-swingup", 1, Spaces())
    guarded.close()


@pytest.mark.parametrize(
    ("action_dim", "changes", "message"),
    [
        (3, {}, "takes actions of 2 numbers, the agent gives 3:"),
        (2, {"choices": ()}, "takes actions of 0, 3 categories, the agent gives continuous actions"),
        (2, {"choices": (0, 4)}, "the agent gives actions of 0, 4 categories"),
        (2, {"frame_size": 64}, "shows 84 pixels a side, the agent sees 64"),
        (2, {"cameras": 1}, "shows 2 cameras, the agent sees 1"),
        (2, {"vector_dim": 0, "cameras": 1}, "agent sees 1, and shows 5 numbers beside a frame, the agent sees 0"),
    ],
)
def test_environment_of_another_form_is_refused_in_one_line(action_dim, changes, message):
    with pytest.raises(UserError, match=message) as refusal:
        refuse_other_spaces(wrap_user_env(Mixed(), config=CONFIG), "mixed", action_dim, replace(OWN, **changes))
    assert "\n" not in str(refusal.value) and "--env-id" in str(refusal.value)
