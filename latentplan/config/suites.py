"""The environment suites by name: the factory, the domains and the tasks of each.

The table needs the standard library only, so that the domain of a run is checked before a simulator is imported.
A new suite is a file with its factory and one entry in `SUITES`; `latentplan.envs.registry` describes the factory.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from latentplan.config.checks import UserError, nearest, shown

DEFAULT_SUITE = "dm_control"
ID_SUITE = ID_DOMAIN = "gymnasium"  # of environments that are named by their id in gymnasium's registry


@dataclass(frozen=True)
class Suite:
    """A family of environments that are made in the same way.

    Attributes:
        factory: The callable that makes an environment, as "module:name"; the module is imported at the first use.
        tasks: The tasks of each domain of the suite, the usual one first; an unknown task is refused before a simulator
            is imported. A text alone is the usual task, and leaves other names to the factory. No two suites share the
            name of a domain: files of settings (`configs/<domain>.yaml`) and named quantities are found by it.
    """

    factory: str
    tasks: Mapping[str, tuple[str, ...] | str]


SUITES: dict[str, Suite] = {
    "dm_control": Suite(
        "latentplan.envs.suite:SuiteEnv",
        {
            "acrobot": ("swingup", "swingup_sparse"),
            "ball_in_cup": ("catch",),
            "cartpole": ("swingup", "balance", "balance_sparse", "swingup_sparse", "two_poles", "three_poles"),
            "cheetah": ("run",),
            "dog": ("walk", "stand", "trot", "run", "fetch"),
            "finger": ("spin", "turn_easy", "turn_hard"),
            "fish": ("swim", "upright"),
            "hopper": ("hop", "stand"),
            "humanoid": ("walk", "stand", "run", "run_pure_state"),
            "humanoid_CMU": ("run", "stand", "walk"),
            "lqr": ("lqr_2_1", "lqr_6_2"),
            "manipulator": ("bring_ball", "bring_peg", "insert_ball", "insert_peg"),
            "pendulum": ("swingup",),
            "point_mass": ("easy", "hard"),
            "quadruped": ("walk", "run", "escape", "fetch"),
            "reacher": ("easy", "hard"),
            "stacker": ("stack_2", "stack_4"),
            "swimmer": ("swimmer6", "swimmer15"),
            "walker": ("walk", "stand", "run"),
        },
    ),
    ID_SUITE: Suite("latentplan.envs.by_id:make", {ID_DOMAIN: "InvertedPendulum-v5"}),
}


def find_suite(name: str) -> Suite:
    """The suite of a name.

    Raises:
        UserError: There is no such suite.
    """
    if name not in tuple(SUITES):  # a settings file may hold a value that is no text
        raise UserError(f"unknown suite {shown(name)}; available: {', '.join(SUITES)}")
    return SUITES[name]


def check_task(suite: str, domain: str, task: object = None) -> tuple[str, ...]:
    """The tasks of a domain, the usual one first; refuses names that the suite does not have, from the table alone.

    Args:
        suite: Name of the suite.
        domain: Domain of the suite.
        task: Name of the task; None stands for the usual task of the domain.

    Raises:
        UserError: There is no such suite, or it has no such domain, or the domain has no such task.
    """
    domains = find_suite(suite).tasks
    if domain not in tuple(domains):  # settings that are made in Python may hold a value that is no text
        raise UserError(_describe_unknown("domain", domain, domains, domains))
    tasks = domains[domain]
    if isinstance(tasks, str):
        return (tasks,)
    if task is not None and task not in tasks:
        raise UserError(_describe_unknown(f"task of {domain}", task, tasks, domains))
    return tasks


def _describe_unknown(
    kind: str, name: object, available: Iterable[str], domains: Mapping[str, tuple[str, ...] | str]
) -> str:
    """An error message for an unknown name, with all available names and what may have been meant.

    Args:
        kind: What the name should have been the name of.
        name: The name.
        available: The names that there are.
        domains: All tasks of the suite, by domain.
    """
    choices = sorted(available)
    meant = repr(nearest(name, choices, cutoff=0.0))
    domain, _, task = str(name).partition("-")
    known = domains.get(domain, ())
    if task in ((known,) if isinstance(known, str) else known):  # both in one name, as in published tables
        meant = f"--domain {domain} --task {task}"
    return f"unknown {kind} {shown(name)}; available: {', '.join(choices)}. Did you mean {meant}?"
