"""`latentplan train`: learn to control a body from pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from latentplan.commands.flags import overrides
from latentplan.config import Config, UserError
from latentplan.config.files import Preset, compose, read_layer
from latentplan.config.parsing import option
from latentplan.config.run_folder import read_run_config

SHORT_FLAGS = {
    "env.domain": "--domain",
    "env.task": "--task",
    "run.frames": "--frames",
    "run.minutes": "--minutes",
    "run.device": "--device",
    "run.seed": "--seed",
    "run.run_dir": "--run-dir",
    "run.logger": "--logger",
}


@dataclass(frozen=True)
class Request:
    """The command line of a training run.

    Attributes:
        preset: Machine class; `auto` takes `gpu` where CUDA is usable.
        config: YAML file of settings, laid over the preset.
        resume: Folder of the run to continue.
        settings: Settings that were given, by section and name.
    """

    RESUMABLE = ("--frames", "--minutes", "--device")
    NOTES = "Values shown are the defaults before configs/<domain>.yaml and the preset are laid over them."

    settings: dict[str, Any] = overrides(Config, SHORT_FLAGS)
    preset: Preset = "auto"
    config: Path | None = option(None, metavar="FILE")
    resume: Path | None = option(None, metavar="DIR")


def run(request: Request) -> int:
    """Train or resume, and return the exit code."""
    config = resolve(request)
    from latentplan.training.checks import check_settings

    check_settings(config)
    from latentplan.training import resume, train

    if request.resume is None:
        return train(config).exit_code
    return resume(request.resume, **request.settings.get("run", {})).exit_code


def resolve(request: Request) -> Config:
    """The settings of the run; those that were saved, with the given ones in their place, when a run resumes.

    Raises:
        UserError: A file cannot be read, a value is not allowed, or there is nothing to resume.
    """
    if request.resume is None:
        return compose(read_layer(request.config) if request.config else {}, request.settings, request.preset)
    if not request.resume.is_dir():
        raise UserError(f"nothing to resume in {request.resume}: give the folder of a run")
    saved, changes = read_run_config(request.resume)[0], request.settings.get("run", {})
    if "frames" in changes or "minutes" in changes:  # a new budget replaces the saved one, of either kind
        changes = {"frames": None, "minutes": None, **changes}
    try:
        return replace(saved, run=replace(saved.run, **changes))
    except ValueError as error:
        raise UserError(f"run.{error}") from None
