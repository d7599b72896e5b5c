"""`latentplan envs`: list the environments that there are, by suite."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from typing import Any

from latentplan.config import EnvConfig, UserError
from latentplan.config.parsing import option
from latentplan.config.suites import ID_SUITE, SUITES, find_suite

WIDTH = 110


@dataclass(frozen=True)
class Request:
    """The command line of a listing.

    Attributes:
        suite: Suite whose environments are made one by one, to list observation, action and length of an episode; None
            lists the names of every suite.
    """

    NOTES = (
        "The suite gymnasium is gymnasium's registry: its environments are given by --env-id, those of other suites by "
        "--domain and --task."
    )

    suite: str | None = option(None, metavar="|".join(SUITES))

    def __post_init__(self) -> None:
        if self.suite is not None:
            find_suite(self.suite)


def run(request: Request) -> int:
    """Print the listing and return the exit code 0."""
    if request.suite is None:
        for suite in SUITES:
            names = list_ids() if suite == ID_SUITE else [f"{domain}-{task}" for domain, task in list_tasks(suite)]
            print(f"{suite}, {len(names)} environments")
            text = textwrap.fill(", ".join(names), WIDTH - 2, break_on_hyphens=False)
            print(textwrap.indent(text, "  "))
        print("--suite NAME lists observation, action and length of an episode of each")
    elif request.suite == ID_SUITE:
        for env_id in list_ids():
            print(f"{env_id:<30} {describe_id(env_id)}", flush=True)
    else:
        for domain, task in list_tasks(request.suite):
            print(f"{domain + '-' + task:<30} {describe_task(request.suite, domain, task)}", flush=True)
    return 0


def list_tasks(suite: str) -> list[tuple[str, str]]:
    """Domain and task of every environment of a suite."""
    domains = find_suite(suite).tasks
    return [
        (domain, task) for domain, tasks in domains.items() for task in ((tasks,) if isinstance(tasks, str) else tasks)
    ]


def list_ids() -> list[str]:
    """The newest version of every environment in gymnasium's registry, in alphabetical order."""
    import gymnasium

    newest: dict[tuple[str | None, str], Any] = {}
    for spec in gymnasium.registry.values():
        key = spec.namespace, spec.name
        if isinstance(spec.entry_point, str) and (key not in newest or (spec.version or 0) > newest[key].version):
            newest[key] = spec
    return sorted(spec.id for spec in newest.values())


def describe_task(suite: str, domain: str, task: str) -> str:
    """Observation, action and length of an episode of a suite's task, in control steps."""
    from latentplan.envs import make_env
    from latentplan.envs.conformance import describe_space

    config = EnvConfig(suite=suite, domain=domain, task=task, action_repeat=1)
    try:
        env = make_env(config, seed=0)
    except UserError as error:
        return str(error)
    try:
        length = env.decisions_per_episode
        spaces = f"{describe_space(env.observation_space)}; action {describe_space(env.action_space)}"
        return f"{spaces}; {f'{length} steps' if length else 'no time limit'}"
    finally:
        env.close()


def describe_id(env_id: str) -> str:
    """Observation, action and length of an episode of an environment by its id, and whether training accepts it."""
    import gymnasium

    from latentplan.config.env_id import by_id
    from latentplan.envs.by_id import make_inner
    from latentplan.envs.conformance import describe_space
    from latentplan.envs.user import describe_refusals

    try:
        env = make_inner(EnvConfig(**by_id(env_id)))
    except UserError as error:
        return str(error).removeprefix(f"cannot make {env_id}: ")
    try:
        length = gymnasium.spec(env_id).max_episode_steps
        spaces = f"{describe_space(env.observation_space)}; action {describe_space(env.action_space)}"
        refusals = describe_refusals(env)
        verdict = "accepted"
        if refusals:
            is_mended = len(refusals) == 1 and "--env.pixels render" in refusals[0]
            verdict = "accepted with --env.pixels render" if is_mended else "not accepted"
        return f"{spaces}; {f'{length} steps' if length else 'no time limit'}; {verdict}"
    finally:
        env.close()
