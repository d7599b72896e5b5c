"""The environment suites by name: the factory and the domains of each.

The table needs the standard library only, so that the domain of a run is checked before a simulator is imported.
A new suite is a file with its factory and one entry in `SUITES`; `latentplan.envs.registry` describes the factory.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from latentplan.config.checks import UserError

DEFAULT_SUITE = "dm_control"


@dataclass(frozen=True)
class Suite:
    """A family of environments that are made in the same way.

    Attributes:
        factory: The callable that makes an environment, as "module:name"; the module is imported at the first use.
        tasks: The usual task of each domain of the suite. No two suites share the name of a domain: files of settings
            (`configs/<domain>.yaml`) and named quantities are found by it.
    """

    factory: str
    tasks: Mapping[str, str]


SUITES: dict[str, Suite] = {
    "dm_control": Suite(
        "latentplan.envs.suite:SuiteEnv",
        {
            "acrobot": "swingup",
            "ball_in_cup": "catch",
            "cartpole": "swingup",
            "cheetah": "run",
            "dog": "walk",
            "finger": "spin",
            "fish": "swim",
            "hopper": "hop",
            "humanoid": "walk",
            "humanoid_CMU": "run",
            "lqr": "lqr_2_1",
            "manipulator": "bring_ball",
            "pendulum": "swingup",
            "point_mass": "easy",
            "quadruped": "walk",
            "reacher": "easy",
            "stacker": "stack_2",
            "swimmer": "swimmer6",
            "walker": "walk",
        },
    ),
}


def find_suite(name: str) -> Suite:
    """The suite of a name.

    Raises:
        UserError: There is no such suite.
    """
    if name not in tuple(SUITES):  # a settings file may hold a value that is no text
        raise UserError(f"unknown suite {name!r}; available: {', '.join(SUITES)}")
    return SUITES[name]
