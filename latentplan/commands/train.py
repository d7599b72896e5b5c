"""`latentplan train`: learn to control a body from pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from latentplan.commands.flags import overrides
from latentplan.config import Config, UserError
from latentplan.config.env_id import FLAG, import_named, lay_env
from latentplan.config.files import BUDGETS, Preset, compose, has_cuda, read_layer
from latentplan.config.parsing import option
from latentplan.config.run_folder import read_run_config

SHORT_FLAGS = {
    "env.domain": "--domain",
    "env.task": "--task",
    "env.kwargs": "--env-kwargs",
    "env.pixels": "--env.pixels",
    "run.frames": "--frames",
    "run.minutes": "--minutes",
    "run.updates": "--updates",
    "run.device": "--device",
    "run.seed": "--seed",
    "run.run_dir": "--run-dir",
    "run.logger": "--logger",
    "run.ray_address": "--run.ray-address",
}


@dataclass(frozen=True)
class Request:
    """The command line of a training run.

    Attributes:
        env_id: Environment of gymnasium's registry, as ID or module:ID, in place of a domain and a task. A module is
            imported; a run that resumes needs it again.
        preset: Machine class; `auto` takes `gpu` where CUDA is usable.
        config: YAML file of settings, laid over the preset.
        resume: Folder of the run to continue.
        settings: Settings that were given, by section and name.
    """

    RESUMABLE = (
        "--frames",
        "--minutes",
        "--updates",
        "--device",
        "--env-id",
        "--run.devices",
        "--run.nodes",
        "--run.strategy",
        "--run.ray-address",
    )
    NOTES = "Values shown are the defaults before configs/<domain>.yaml and the preset are laid over them."

    settings: dict[str, Any] = overrides(Config, SHORT_FLAGS)
    env_id: str | None = option(None, metavar="[MODULE:]ID")
    preset: Preset = "auto"
    config: Path | None = option(None, metavar="FILE")
    resume: Path | None = option(None, metavar="DIR")

    def __post_init__(self) -> None:
        lay_env(self.settings.get("env", {}), self.env_id)


def run(request: Request) -> int:
    """Train or resume, and return the exit code."""
    config = _without_cuda(request, resolve(request))
    if request.env_id is not None:
        import_named(request.env_id)
    from latentplan.training.checks import check_settings
    from latentplan.training.demonstrations.kinds import find_recordings

    check_settings(config, is_new=request.resume is None)
    if request.resume is None:  # a run that resumes has its recorded episodes in its saves
        find_recordings(config.replay.demonstrations)
    from latentplan.training import resume, train

    if request.resume is None:
        return train(config).exit_code
    return resume(request.resume, **request.settings.get("run", {})).exit_code


def _without_cuda(request: Request, config: Config) -> Config:
    """The settings; those of the CPU where the preset was chosen for a graphics processor that torch cannot use."""
    if request.resume is not None or request.preset != "auto" or config.run.device != "auto" or not has_cuda():
        return config
    import torch

    if torch.cuda.is_available():
        return config
    print("torch cannot use this machine's graphics processor: the settings are those of the CPU", flush=True)
    return resolve(replace(request, preset="cpu"))


def resolve(request: Request) -> Config:
    """The settings of the run; those that were saved, with the given ones in their place, when a run resumes.

    Raises:
        UserError: A file cannot be read, a value is not allowed, or there is nothing to resume.
    """
    if request.resume is None:
        given = request.settings
        if request.env_id is not None:
            given = {**given, "env": lay_env(given.get("env", {}), request.env_id)}
        return compose(read_layer(request.config) if request.config else {}, given, request.preset)
    if not request.resume.is_dir():
        raise UserError(f"nothing to resume in {request.resume}: give the folder of a run")
    saved, changes = read_run_config(request.resume)[0], request.settings.get("run", {})
    if request.env_id not in (None, saved.env.task):
        raise UserError(
            f"{FLAG} {request.env_id} is not the environment of {request.resume}, which learns in "
            f"{saved.env.domain}-{saved.env.task}; only the same can be given"
        )
    if set(BUDGETS) & set(changes):  # a new budget replaces the saved one, of any kind
        changes = dict.fromkeys(BUDGETS) | changes
    try:
        return replace(saved, run=replace(saved.run, **changes))
    except UserError:  # of settings that contradict each other, which it names in full
        raise
    except ValueError as error:
        raise UserError(f"run.{error}") from None
