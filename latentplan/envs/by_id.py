"""The suite `gymnasium`: environments of gymnasium's registry, named by their id; see `latentplan.config.env_id`."""

from __future__ import annotations

import re
import traceback
import warnings
from typing import Any

import gymnasium
from gymnasium.envs import registration
from gymnasium.error import DependencyNotInstalled, UnregisteredEnv

from latentplan.config import EnvConfig, UserError
from latentplan.config.checks import nearest, shown
from latentplan.config.env_id import FLAG, require_imported, split_id
from latentplan.config.reading import read_kwargs
from latentplan.config.suites import check_task
from latentplan.envs.faults import describe_failure, describe_lack
from latentplan.envs.rendered import MODE
from latentplan.envs.user import PixelEnv, make_from

RAISED_BY_ENV = " was raised from the environment creator"  # what gymnasium adds to a TypeError of an environment


def make(config: EnvConfig, seed: int | None = None) -> PixelEnv:
    """The environment that `config.task` names, with the frames and actions of an agent; see `wrap_user_env`.

    Raises:
        UserError: The id is unknown, its module was not imported, the environment cannot be made with these arguments,
            or agents cannot learn from its observations or actions.
    """
    return make_from(lambda: make_inner(config))(config, seed)


def make_inner(config: EnvConfig) -> gymnasium.Env[Any, Any]:
    """The environment that `config.task` names, with its own observations and actions.

    Raises:
        UserError: See `make`.
        EnvironmentFault: The environment's own code failed.
    """
    name, kwargs = find_id(config), read_kwargs(config.kwargs)
    _check_kwargs(kwargs)
    if config.pixels == "render":
        kwargs = {"render_mode": MODE, **kwargs}
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*render_mode.*")  # `RenderedEnv` refuses a wrong mode
            env = gymnasium.make(name, disable_env_checker=True, **kwargs)
    except UnregisteredEnv as error:
        raise UserError(f"cannot make {name}: {' '.join(str(error).split())}") from None
    except (DependencyNotInstalled, ModuleNotFoundError) as error:
        raise UserError(describe_lack(error, f"cannot make {name}: it")) from None
    except TypeError as error:
        own = error.__cause__ if RAISED_BY_ENV in str(error) and error.__cause__ is not None else error
        if blame := _blame_arguments(own, config):
            raise UserError(f"cannot make {name}{blame}") from None
        raise describe_failure(own) from error
    except Exception as error:
        raise describe_failure(error) from error
    if config.pixels == "render":
        _draw_small(env, kwargs, config.frame_size)
    return env


def _check_kwargs(kwargs: dict[str, Any]) -> None:
    """Refuses arguments that are gymnasium's and not the environment's, unless they can be passed on."""
    for name in ("id", "disable_env_checker"):
        if name in kwargs:
            raise UserError(f"--env-kwargs cannot hold {name!r}, which this program sets: leave it out")
    limit = kwargs.get("max_episode_steps")
    if limit is not None and (type(limit) is not int or limit == 0 or limit < -1):
        allowed = "a whole number of at least 1, or -1 for no limit"
        raise UserError(f"--env-kwargs: max_episode_steps must be {allowed}, got {shown(limit)}")


def find_id(config: EnvConfig) -> str:
    """The id of the environment in gymnasium's registry; nothing is made.

    Raises:
        UserError: The registry does not have it, or the module that registers it was not imported.
    """
    require_imported(config)
    _, name = split_id(config.task or check_task(config.suite, config.domain)[0])
    try:
        gymnasium.spec(name)
    except gymnasium.error.Error:
        similar = nearest(name, gymnasium.registry, cutoff=0.6)
        hint = f"; did you mean {similar!r}?" if similar else ";"
        raise UserError(
            f"unknown environment {name!r}{hint} `latentplan envs --suite gymnasium` lists gymnasium's own, and {FLAG} "
            f"module:{name} imports the module that registers another"
        ) from None
    return name


def _blame_arguments(error: BaseException, config: EnvConfig) -> str:
    """What is wrong with the arguments of an environment and its remedy; empty for an error of another kind."""
    given, text = read_kwargs(config.kwargs), str(error)
    found = re.search(r"unexpected keyword argument '(\w+)'", text)
    unknown, is_by_call = found and found[1], _is_raised_by_call(error)
    if unknown in given or (given and unknown is None and is_by_call):
        return f" with --env-kwargs {config.kwargs}: {text}; correct them"
    if config.pixels == "render" and (unknown == "render_mode" or (is_by_call and "takes no arguments" in text)):
        return (
            f" with --env.pixels render: {text}; give its __init__ an argument render_mode that sets "
            "self.render_mode, and the class a render() that returns uint8 pictures (height, width, 3)"
        )
    return f": {text}; give it with --env-kwargs" if is_by_call and "missing" in text else ""


def _is_raised_by_call(error: BaseException) -> bool:
    """Whether the call of the environment's class raised an error, and not the code of the class."""
    frames = traceback.extract_tb(error.__traceback__)
    return frames[-1].filename == registration.__file__


def _draw_small(env: gymnasium.Env[Any, Any], kwargs: dict[str, Any], size: int) -> None:
    """Makes gymnasium's MuJoCo renderer draw at the size of a frame, which takes a tenth of the time of 480 x 480."""
    renderer = getattr(env.unwrapped, "mujoco_renderer", None)
    if renderer is not None and not {"width", "height"} & set(kwargs):
        renderer.width = renderer.height = size
