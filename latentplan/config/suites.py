"""The environment suites by name: the factory and the domains of each.

The table needs the standard library only, so that the domain of a run is checked before a simulator is imported.
A new suite is a file with its factory and one entry in `SUITES`; `latentplan.envs.registry` describes the factory.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from latentplan.config.checks import UserError, shown
from latentplan.config.parsing import raise_unknown

DEFAULT_SUITE = "dm_control"


@dataclass(frozen=True)
class Suite:
    """A family of environments that are made in the same way.

    Attributes:
        factory: The callable that makes an environment, as "module:name"; the module is imported at the first use.
        tasks: The usual task of each domain of the suite. No two suites share the name of a domain: files of settings
            (`configs/<domain>.yaml`) and named quantities are found by it.
        names: Every task of each domain, so that an unknown task is refused before a simulator is imported. The tasks
            of a domain that is missing here are checked by the factory.
    """

    factory: str
    tasks: Mapping[str, str]
    names: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


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
        {
            "acrobot": ("swingup", "swingup_sparse"),
            "ball_in_cup": ("catch",),
            "cartpole": ("balance", "balance_sparse", "swingup", "swingup_sparse", "two_poles", "three_poles"),
            "cheetah": ("run",),
            "dog": ("stand", "walk", "trot", "run", "fetch"),
            "finger": ("spin", "turn_easy", "turn_hard"),
            "fish": ("upright", "swim"),
            "hopper": ("stand", "hop"),
            "humanoid": ("stand", "walk", "run", "run_pure_state"),
            "humanoid_CMU": ("stand", "walk", "run"),
            "lqr": ("lqr_2_1", "lqr_6_2"),
            "manipulator": ("bring_ball", "bring_peg", "insert_ball", "insert_peg"),
            "pendulum": ("swingup",),
            "point_mass": ("easy", "hard"),
            "quadruped": ("walk", "run", "escape", "fetch"),
            "reacher": ("easy", "hard"),
            "stacker": ("stack_2", "stack_4"),
            "swimmer": ("swimmer6", "swimmer15"),
            "walker": ("stand", "walk", "run"),
        },
    ),
}


def find_suite(name: str) -> Suite:
    """The suite of a name.

    Raises:
        UserError: There is no such suite.
    """
    if name not in tuple(SUITES):  # a settings file may hold a value that is no text
        raise UserError(f"unknown suite {shown(name)}; available: {', '.join(SUITES)}")
    return SUITES[name]


def check_task(suite: str, domain: str, task: object) -> None:
    """Refuses a task that the suite does not have, from the table alone.

    Args:
        suite: Name of the suite.
        domain: Domain of the suite.
        task: Name of the task; None stands for the usual task of the domain.

    Raises:
        UserError: There is no such suite, or the domain has no such task.
    """
    names = find_suite(suite).names.get(domain)
    if task is not None and names is not None and task not in names:
        raise_unknown(f"task of {domain}", str(task), names)
