"""Environments that gymnasium's registry knows by an id, such as `InvertedPendulum-v5` or `my_robot:Reach-v0`.

In the settings such an environment is the suite `gymnasium` with the domain `gymnasium`, and the id is the task. The
part before a colon is a module whose import registers the id. A module runs code, so that only the command line or the
user's own program imports it. An id that was read from a checkpoint, a run folder or a file imports nothing.
"""

from __future__ import annotations

import importlib
import os
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from latentplan.config.checks import EnvironmentFault, UserError, cut, shown
from latentplan.config.extras import describe_missing, extra_of
from latentplan.config.parsing import option
from latentplan.config.settings import EnvConfig, Pixels
from latentplan.config.suites import ID_DOMAIN, ID_SUITE

FLAG = "--env-id"
_IMPORTERS = (__file__, importlib.__file__, "<frozen importlib")
ENV_FLAGS = {"id": FLAG, "kwargs": "--env-kwargs", "pixels": "--env.pixels"}


@dataclass(frozen=True)
class EnvChoice:
    """The environment of a trained agent, where it is not the one that the agent remembers.

    Attributes:
        id: Environment of gymnasium's registry, as ID or module:ID; None takes the environment that the agent learned
            in. A module that the agent remembers is never imported: give it here.
        kwargs: Arguments of that environment, as a JSON object.
        pixels: Where the agent's pictures come from: `observation`, or `render` for those that `render()` draws.
    """

    id: str | None = option(None, metavar="[MODULE:]ID")
    kwargs: str = option("{}", metavar="JSON")
    pixels: Pixels = "observation"


def by_id(env_id: str) -> dict[str, Any]:
    """The settings of the section `env` that an id stands for.

    Raises:
        UserError: The text is no id.
    """
    split_id(env_id)
    return {"suite": ID_SUITE, "domain": ID_DOMAIN, "task": env_id}


def lay_env(given: Mapping[str, Any], env_id: str | None) -> dict[str, Any]:
    """The section `env` that flags give: those of the section, and an id, which names the environment alone.

    Raises:
        UserError: Both name an environment, or the text is no id.
    """
    if env_id is None:
        return dict(given)
    for name, flag in {"domain": "--domain", "task": "--task", "suite": "--env.suite"}.items():
        if name in given:
            raise UserError(
                f"{FLAG} and {flag} cannot both be given: an environment of gymnasium's registry has an id, one of a "
                "suite a domain and a task"
            )
    return {**given, **by_id(env_id)}


def is_by_id(env: EnvConfig) -> bool:
    """Whether an environment of gymnasium's registry is named by its id."""
    return env.suite == ID_SUITE


def split_id(env_id: str) -> tuple[str | None, str]:
    """The module of an id, or None, and the id without it.

    Raises:
        UserError: The text is no id.
    """
    module, colon, name = env_id.rpartition(":")
    if not re.fullmatch(r"[\w.+/-]+", name) or (colon and not all(part.isidentifier() for part in module.split("."))):
        raise UserError(
            f"{FLAG} must be an id of gymnasium's registry, such as InvertedPendulum-v5, or module:ID for one that a "
            f"module registers, got {shown(env_id)}"
        )
    return module or None, name


def import_named(env_id: str) -> None:
    """Imports the module that an id of the command line names; modules in the present folder are found too.

    Raises:
        UserError: There is no such module.
        EnvironmentFault: The module cannot be imported; the error has the traceback of the module.
    """
    module, name = split_id(env_id)
    if module is None:
        return
    if os.getcwd() not in sys.path and "" not in sys.path:
        sys.path.append(os.getcwd())
    try:
        importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is not None and (module == error.name or module.startswith(f"{error.name}.")):
            if module.endswith(".py"):
                right = f"{FLAG} {module.removesuffix('.py')}:{name}"
                raise UserError(f"{FLAG} {env_id}: name the module without .py, as in {right}") from None
            top = module.partition(".")[0]
            extra = f"pip install 'latentplan[{extra_of(top)}]'" if extra_of(top) else "install its package"
            raise UserError(
                f"{FLAG} {env_id}: there is no module {module} to import; {extra}, or run the command in the folder of "
                f"{top}.py"
            ) from None
        raise UserError(describe_missing(str(error.name), f"{FLAG} {env_id}: the module {module}")) from None
    except Exception as error:  # the code of the module may raise anything
        reason = cut(str(error)) or "no reason given"
        raise EnvironmentFault(
            f"{FLAG} {env_id}: importing {module} raised {type(error).__name__}: {reason}; mend the module",
            _trace_module(error),
        ) from None


def _trace_module(error: Exception) -> str:
    """The traceback of a module that cannot be imported, without the frames of what imports it."""
    import traceback

    own = error.__traceback__
    while own is not None and own.tb_frame.f_code.co_filename.startswith(_IMPORTERS):
        own = own.tb_next
    return "".join(traceback.format_exception(type(error), error, own))


def imported_modules(env: EnvConfig) -> tuple[str, ...]:
    """The module that the settings name, if this process has imported it: what its child processes may import too."""
    module = _module_of(env)
    return (module,) if module in sys.modules else ()


def require_imported(env: EnvConfig) -> None:
    """Refuses an id whose module nobody has imported.

    Raises:
        UserError: The module has to be named again.
    """
    module = _module_of(env)
    if module is not None and module not in sys.modules:
        raise UserError(
            f"{env.task} names the module {module}, and a module is never imported because a checkpoint or a file "
            f"names it: give {FLAG} {env.task} (in Python: import {module})"
        )


def repeat_flag(env: EnvConfig) -> str:
    """The flag that a command needs again to go on in this environment, with a space before it; empty without one."""
    module = _module_of(env)
    return "" if module is None else f" {FLAG} {env.task}"


def choose_env(saved: EnvConfig, given: Mapping[str, Any], *, must_match: bool = False) -> EnvConfig:
    """The environment of an agent with the given fields of `EnvChoice` in place of the remembered ones.

    A given module is imported. Another id than the remembered one starts without arguments.

    Args:
        saved: The environment that the agent remembers.
        given: Given fields of `EnvChoice`, by name.
        must_match: Whether an id other than the remembered one is refused.

    Raises:
        UserError: The id is no id, its module cannot be imported, or a value is not allowed.
    """
    env_id, changes = given.get("id"), {name: value for name, value in given.items() if name != "id"}
    if env_id is not None:
        is_same = is_by_id(saved) and split_id(env_id)[1] == split_id(str(saved.task))[1]
        if must_match and is_by_id(saved) and not is_same:
            raise UserError(f"{FLAG} {env_id} is another environment than {saved.task}, which is remembered; give that")
        changes = {**by_id(env_id), "kwargs": saved.kwargs if is_same else EnvChoice.kwargs, **changes}
    elif changes and not is_by_id(saved):
        flag = ENV_FLAGS[next(iter(changes))]
        raise UserError(f"{flag} has no effect in {saved.domain}-{saved.task}; give {FLAG} too")
    try:
        env = replace(saved, **changes)
    except ValueError as error:
        raise UserError(f"env.{error}") from None
    if env_id is not None:
        import_named(env_id)
    return env


def as_file_name(text: str) -> str:
    """A text without the characters of ids that are not for names of folders."""
    return re.sub(r"[^\w.+-]+", "-", text)


def _module_of(env: EnvConfig) -> str | None:
    """The module that the settings name; None without one."""
    return split_id(env.task)[0] if is_by_id(env) and env.task else None
