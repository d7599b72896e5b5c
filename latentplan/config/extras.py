"""Libraries that only an extra of the package installs, and the error that names this extra."""

from __future__ import annotations

import sys
from importlib import import_module, util
from types import ModuleType

from latentplan.config.checks import UserError

EXTRAS = {
    "train": (
        *("cv2", "dm_control", "gymnasium", "jsonargparse", "lightning", "matplotlib", "mujoco", "rich", "scipy"),
        *("shtab", "tensorboard", "yaml"),
    ),
    "bench": ("rliable",),
    "view": ("starlette", "uvicorn", "websockets", "plotly"),
    "browser": ("playwright",),
    "jax": ("jax",),
    "gymnasium": ("imageio", "pygame"),
    "robotics": ("gymnasium_robotics",),
    "data": ("h5py", "minari"),
    "lerobot": ("pyarrow", "av"),
    "wandb": ("wandb",),
    "trackio": ("trackio",),
    "mlflow": ("mlflow",),
    "hub": ("huggingface_hub",),
    "ray": ("ray", "optuna"),
}
"""By extra, the modules that it installs and the package without extras does not."""


DM_CONTROL = "--no-deps 'dm-control>=1.0.50,<1.1'"
"""What pip installs of dm_control from Python 3.13 on, where no extra can list it: pip cannot build labmaze there."""


class MissingExtra(UserError, ImportError):
    """A library is not installed; the message names the extra that installs it."""


def extra_of(module: str | None) -> str | None:
    """The extra that installs a module; None for a module that belongs to no extra.

    Args:
        module: A dotted name, such as the `name` of a `ModuleNotFoundError`.
    """
    top = (module or "").partition(".")[0]
    return next((extra for extra, modules in EXTRAS.items() if top in modules), None)


def require_extra(user: str, *modules: str) -> None:
    """Requires modules to be installed, without importing them.

    Args:
        user: The part that needs the modules, for the error.
        *modules: Names of `EXTRAS`.

    Raises:
        MissingExtra: A module is not installed.
    """
    for module in modules:
        if util.find_spec(module) is None:
            raise MissingExtra(describe_missing(module, user))


def import_extra(module: str, user: str) -> ModuleType:
    """The module of an extra.

    Args:
        module: A name of `EXTRAS`.
        user: The part that needs the module, for the error.

    Raises:
        MissingExtra: The module is not installed.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        if extra_of(error.name) is None:
            raise
        raise MissingExtra(describe_missing(module, user)) from None


def describe_missing(module: str, user: str) -> str:
    """One line that says which module a part lacks, and how to install it."""
    extra = extra_of(module)
    what = f"'latentplan[{extra}]'" if extra else module
    if module.partition(".")[0] == "dm_control" and sys.version_info >= (3, 13):
        what = DM_CONTROL
    return f"{user} needs {module}, which is not installed; run: pip install {what}"
