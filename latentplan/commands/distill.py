"""`latentplan distill`: teach a trained agent's actor to act as its planner does."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from latentplan.commands.flags import overrides
from latentplan.commands.shell import (
    LearningRequest,
    check_search,
    name_folder,
    read_search,
    saved_config,
    search_settings,
)
from latentplan.config import DistillConfig, PlannerConfig
from latentplan.config.env_id import ENV_FLAGS, EnvChoice
from latentplan.config.run_folder import DISTILLATION, require_saves


@dataclass(frozen=True, kw_only=True)
class Request(LearningRequest):
    """The command line of a distillation.

    Attributes:
        settings: Settings of the distillation that were given.
        planner: Settings of the search that labels, in place of the agent's own.
        env: The environment of an agent that learned in one of the user's; of gymnasium's registry, as for training.
    """

    RESUMABLE = ("--rounds", "--minutes", "--device", "--threads", *ENV_FLAGS.values())
    NOTES = "The world model stays as it is. --planner.* replace the settings of the agent's own search."

    settings: dict[str, Any] = overrides(DistillConfig)
    planner: dict[str, Any] = overrides(PlannerConfig, prefix="planner.")
    env: dict[str, Any] = overrides(EnvChoice, ENV_FLAGS, prefix="env.")

    def __post_init__(self) -> None:
        super().__post_init__()
        DistillConfig(**self.settings)


def resolve(request: Request) -> dict[str, Any]:
    """The fields of the request, with every setting of the distillation and of the search that labels.

    Raises:
        UserError: The agent cannot be read, a setting is not allowed, or there is nothing to resume.
    """
    if request.resume is not None:
        require_saves(request.resume, DISTILLATION)  # before torch is imported
        from latentplan.training.distillation.saves import read_resumed

        _, settings, planner = read_resumed(request.resume, **request.settings)
    else:
        assert request.checkpoint is not None
        settings, planner = DistillConfig(**request.settings), read_search(request.checkpoint, request.planner)
    return {**vars(request), "settings": settings, "planner": planner}


def run(request: Request) -> int:
    """Distil, or continue a distillation, and return the exit code."""
    from latentplan.agents.info import read_info

    info = {} if request.checkpoint is None else read_info(request.checkpoint)
    planner = None
    if request.planner and request.checkpoint is not None:
        saved = saved_config(request.checkpoint, info)
        planner = search_settings(saved, request.planner)
        check_search(planner, saved.model)
    if request.resume is not None:  # before torch is imported
        require_saves(request.resume, DISTILLATION)
    device = request.use_device()
    from latentplan.training import distill, resume_distillation

    if request.resume is not None:
        return resume_distillation(request.resume, device=device, env=request.env, **request.settings).exit_code
    assert request.checkpoint is not None
    out = request.out or name_folder("distilled", info)
    settings = DistillConfig(**request.settings)
    return distill(request.checkpoint, out, settings, planner=planner, device=device, env=request.env).exit_code
