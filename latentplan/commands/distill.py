"""`scripts/distill.py`: a trained agent's actor, taught what its planner does.

Torch and the simulator are imported when they are needed, so that `--help` and bad input answer at once.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from latentplan.commands.flags import (
    COMMON_FLAGS,
    LearningRequest,
    describe_settings,
    name_folder,
    read_request,
    setting_kinds,
)
from latentplan.commands.main import read_flags, run_guarded, use_device
from latentplan.config import DistillConfig, PlannerConfig, UserError, from_dict, to_dict
from latentplan.config.files import build_config, field_names
from latentplan.config.planner import override_planner

FLAGS = {
    "--checkpoint": ("DIR", "folder of a trained agent, or of a run (its best checkpoint)"),
    "--out": ("DIR", "folder of the distilled agent (runs/distilled-<domain>-<task>-<date>)"),
    **COMMON_FLAGS,
}
RESUMABLE = ("--rounds", "--minutes", "--device", "--threads")


@dataclass(frozen=True)
class DistillRequest(LearningRequest):
    """What the command line asks for.

    Attributes:
        planner: Planner settings that replace the agent's, as they were typed.
    """

    planner: dict[str, str]


def main(argv: Sequence[str] | None = None) -> int:
    """Run `scripts/distill.py` and return the exit code: 0, 2 for bad input, 130 when interrupted."""
    return run_guarded(_distill, sys.argv[1:] if argv is None else argv)


def parse_arguments(argv: Sequence[str]) -> DistillRequest:
    """Read the command line.

    Raises:
        UserError: A flag or value is wrong; the message says what to give.
    """
    kinds = setting_kinds(DistillConfig)
    searches = [f"--planner.{name}" for name in field_names("planner")]
    flags = read_flags(argv, [*FLAGS, *kinds, *searches])
    request = read_request(DistillConfig, flags, RESUMABLE)
    planner = {flag.removeprefix("--planner."): flags[flag] for flag in searches if flag in flags}
    return DistillRequest(**vars(request), planner=planner)


def _distill(argv: Sequence[str]) -> int:
    if "-h" in argv or "--help" in argv:
        print(_help())
        return 0
    request = parse_arguments(argv)
    from latentplan.agents.checkpoint import read_info

    info = read_info(request.checkpoint) if request.checkpoint is not None else {}
    planner = _planner(request, info) if request.planner else None
    device = use_device(request.device, request.threads)
    from latentplan.training import distill, resume_distillation

    if request.resume is not None:
        return resume_distillation(request.resume, device=device, **request.settings).exit_code
    assert request.checkpoint is not None
    out = request.out or name_folder("distilled", info)
    settings = DistillConfig(**request.settings)
    return distill(request.checkpoint, out, settings, planner=planner, device=device).exit_code


def _planner(request: DistillRequest, info: dict[str, Any]) -> PlannerConfig:
    """The agent's search, with what was given in its place."""
    try:
        trained = to_dict(from_dict(info["config"]).planner)
    except (AttributeError, TypeError, ValueError) as error:
        raise UserError(f"{request.checkpoint} has settings of another version: {error}") from None
    return build_config({"planner": override_planner(trained, request.planner)}).planner


def _help() -> str:
    """Flags with their meanings."""
    rows = [(f"{flag} {metavar}", meaning) for flag, (metavar, meaning) in FLAGS.items()]
    rows += describe_settings(DistillConfig)
    rows.append(("--planner.NAME V", "setting of the search that labels, in place of the agent's; see eval.py --help"))
    lines = "\n".join(f"  {flag:<24}{meaning}" for flag, meaning in rows)
    return (
        "usage: distill.py --checkpoint DIR [--name value ...]\n\n"
        "Teach a trained agent's actor what its planner does; the world model stays as it is.\n"
        f"With --resume only {', '.join(RESUMABLE)} may be given.\n\n{lines}"
    )
