"""Checks of a run's settings that need no torch: names, expressions, memory and time."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path

from latentplan.config import USER_DOMAIN, Config, EnvConfig, RunConfig, UserError
from latentplan.config.checks import is_utf8, shown
from latentplan.config.env_id import is_by_id
from latentplan.config.extras import EXTRAS, require_extra
from latentplan.config.parsing import raise_unknown
from latentplan.config.planner import METHODS
from latentplan.config.quantities import TASK_PREFIX, scales
from latentplan.config.suites import DEFAULT_SUITE, check_task
from latentplan.objectives.expression import Name, Node
from latentplan.objectives.parser import parse_objective, parse_reward
from latentplan.training.estimates import check_run


def check_settings(config: Config, *, is_new: bool = True) -> None:
    """Refuses a run that cannot work, before its first process starts.

    Args:
        config: Settings of the run.
        is_new: Whether settings that have no effect are refused; a saved run may hold those of an earlier version.

    Raises:
        UserError: A task, a planner or an expression does not exist, or the machine cannot serve the run.
    """
    check_run(config)
    check_machines(config.run)
    if config.run.run_dir is not None:
        check_folder(config.run.run_dir)
    for name in config.run.logger:
        if name in EXTRAS:
            require_extra(f"the logger {name}", *EXTRAS[name])
    if config.collection.backend == "ray":
        require_extra("collection.backend ray", "ray")
    if config.collection.keep_episodes is not None:
        check_folder(config.collection.keep_episodes, "--collection.keep_episodes")
        require_extra("collection.keep_episodes", "h5py")
    env, learning = config.env, config.learning
    check_env_settings(env, is_new=is_new)
    if env.suite == DEFAULT_SUITE and env.domain != USER_DOMAIN:
        known = scales(env.domain)
        if env.objective is not None:
            parse_reward(env.objective, known, "env.objective")
        for goal in config.collection.goals:
            parse_objective(goal, known)
        if learning.curriculum_task not in (None, env.task) and learning.curriculum_frames > 0:
            parse_curriculum_task(str(learning.curriculum_task), known)
    check_planner(config.planner.method)


def check_planner(method: str) -> None:
    """Refuses a planner that is not registered, without importing torch.

    Raises:
        UserError: There is no such planner.
    """
    registry = sys.modules.get("latentplan.planning.search.registry")  # imported where a program has added a planner
    known = METHODS if registry is None else registry.PLANNERS
    if method not in known:
        raise_unknown("planner", method, known)


def check_launcher() -> None:
    """Refuses wrong numbers in the variables with which a launcher numbers its processes.

    Raises:
        UserError: A variable is wrong; Lightning would fail on it when it is imported.
    """
    for rank, size in (("RANK", "WORLD_SIZE"), ("LOCAL_RANK", "LOCAL_WORLD_SIZE")):
        if rank in os.environ:
            number = read_number(rank)
            if size in os.environ:
                _check_below(rank, number, size, read_number(size))


def check_machines(run: RunConfig) -> None:
    """Refuses processes or machines that cannot find each other, from the variables of the environment alone.

    Raises:
        UserError: A variable is missing or wrong, so that the processes would wait for ever.
    """
    check_launcher()
    nodes, needed = run.nodes, ["MASTER_ADDR", "MASTER_PORT"]
    if is_started_outside():
        nodes = read_number("WORLD_SIZE") // read_number("LOCAL_WORLD_SIZE", os.environ["WORLD_SIZE"])
    elif "SLURM_JOB_ID" in os.environ:  # Lightning reads the numbers of Slurm
        return
    else:
        needed.append("NODE_RANK")
        if run.num_ranks > 1:
            _check_below("NODE_RANK", read_number("NODE_RANK", "0"), "run.nodes", run.nodes)
    if nodes > 1 and not set(needed) <= set(os.environ):
        raise UserError(
            f"run.nodes {nodes} needs {', '.join(needed[:-1])} and {needed[-1]} in the environment of each machine, or "
            "torchrun, which sets them"
        )


def _check_below(name: str, number: int, limit_name: str, limit: int) -> None:
    if number >= limit:
        raise UserError(f"{name} ({number}) must be below {limit_name} ({limit}): the first has number 0")


def is_started_outside() -> bool:
    """Whether torchrun or another launcher has started this process as one of several."""
    return {"RANK", "WORLD_SIZE"} <= set(os.environ)


def read_number(name: str, default: str | None = None) -> int:
    """The number in a variable of the environment that a launcher sets; a rank is at least 0, a size at least 1.

    Args:
        name: The variable.
        default: Its text where it is not set.

    Raises:
        UserError: The variable holds something else.
    """
    text = os.environ.get(name, default or "")
    is_rank = name.endswith("RANK")
    if not text.isdecimal() or (int(text) == 0 and not is_rank):
        allowed = "a whole number, at least 0" if is_rank else "a number above 0"
        raise UserError(f"the environment variable {name} must be {allowed}, got {shown(text)}")
    return int(text)


def check_env_settings(env: EnvConfig, *, is_new: bool = True) -> None:
    """Refuses names of environments that do not exist, and settings that have no effect in the environment.

    Args:
        env: Settings of the environment.
        is_new: See `check_settings`.

    Raises:
        UserError: There is no such environment, or a setting has no effect.
    """
    if env.domain != USER_DOMAIN:
        check_task(env.suite, env.domain, env.task)
    if is_by_id(env) and env.domain != USER_DOMAIN:
        if env.objective is not None:
            raise UserError(f"env.objective needs a domain with named quantities; {env.task} returns its own reward")
        for name in ("camera", "render_quality", "render_slices", "floor") if is_new else ():
            if getattr(env, name) != getattr(EnvConfig, name):
                raise UserError(
                    f"--env.{name} has no effect in {env.task or env.domain}, which draws its own pictures: leave it "
                    "out, and give the environment's own arguments with --env-kwargs"
                )
        from latentplan.envs.by_id import find_id

        find_id(env)
    elif env.kwargs != EnvConfig.kwargs and env.suite == DEFAULT_SUITE:
        raise UserError("--env-kwargs has no effect here: give --env-id too")
    elif env.pixels != EnvConfig.pixels and env.suite == DEFAULT_SUITE and env.domain != USER_DOMAIN:
        raise UserError(f"--env.pixels has no effect in {env.domain}, which always renders: leave it out")


def check_folder(run_dir: str, flag: str = "--run-dir") -> None:
    """Refuses a folder of a run that cannot be made, without making it.

    Args:
        run_dir: The folder.
        flag: The flag that names it, for the error.

    Raises:
        UserError: The name is empty, begins with `~` or is not UTF-8, a file is in the way, or the folders above may
            not be read.
        OSError: The name is too long.
    """
    if run_dir == "":
        raise UserError(f"{flag} must name a folder, got an empty text")
    if run_dir.startswith("~"):
        raise UserError(
            f"{flag} {run_dir!r} would be a folder named '~' here: write the home folder out, as in $HOME/runs"
        )
    if not is_utf8(run_dir):  # as the settings, which hold it
        raise UserError(f"{flag} must be UTF-8, got {run_dir!r}")
    folder = Path(run_dir).absolute()
    try:
        existing = next(path for path in (folder, *folder.parents) if path.exists())
        reason = None if existing.is_dir() else f"{existing} is a file"
    except PermissionError as error:
        reason = f"{error.strerror}: {error.filename}"
    if reason is not None:
        raise UserError(f"cannot make the folder {run_dir}: {reason}; choose another {flag}")


def parse_curriculum_task(text: str, labels: Mapping[str, float]) -> tuple[tuple[float, Node], ...]:
    """Weighted terms of the curriculum's reward, from a task's name or from an expression over quantities.

    Args:
        text: `learning.curriculum_task`.
        labels: Quantities that label each frame, and their scales.

    Raises:
        UserError: The text is neither.
    """
    if TASK_PREFIX + text in labels:
        return ((1.0, Name(TASK_PREFIX + text)),)
    try:
        return parse_reward(text, labels, "learning.curriculum_task").terms
    except UserError as error:
        tasks = [name.removeprefix(TASK_PREFIX) for name in labels if name.startswith(TASK_PREFIX)]
        raise UserError(
            f"learning.curriculum_task {shown(text)} is unknown; tasks with known rewards in this domain: "
            f"{', '.join(tasks) or 'none'}; as an expression: {error}"
        ) from None
