"""`scripts/distill.py`: a trained agent's actor, taught what its planner does.

Torch and the simulator are imported when they are needed, so that `--help` and bad input answer at once.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from latentplan.cli import read_flags, run_guarded, use_device
from latentplan.compose import build_config, field_names, raise_unknown
from latentplan.config import DEVICES, DistillConfig, PlannerConfig, UserError, from_dict, to_dict
from latentplan.config.planner import override_planner
from latentplan.setting_flags import describe_settings, read_settings, read_threads, setting_kinds

FLAGS = {
    "--checkpoint": ("DIR", "folder of a trained agent, or of a run (its best checkpoint)"),
    "--out": ("DIR", "folder of the distilled agent (runs/distilled-<domain>-<task>-<date>)"),
    "--resume": ("DIR", "continue the distillation in this folder"),
    "--device": ("|".join(DEVICES), "where the agent computes (auto: cuda where usable)"),
    "--threads": ("N", "CPU threads (torch's own choice)"),
}
RESUMABLE = ("--rounds", "--minutes", "--device", "--threads")


@dataclass(frozen=True)
class DistillRequest:
    """What the command line asks for.

    Attributes:
        checkpoint: Folder of the agent to begin with; None when a distillation resumes.
        out: Where the distilled agent goes, or None for a folder of its own under `runs`.
        resume: Folder of the distillation to continue, or None.
        settings: Fields of `DistillConfig` that were given.
        planner: Planner settings that replace the agent's, as they were typed.
        device: `auto`, `cpu` or `cuda`.
        threads: CPU threads, or None to leave it to torch.
    """

    checkpoint: Path | None
    out: Path | None
    resume: Path | None
    settings: dict[str, Any]
    planner: dict[str, str]
    device: str
    threads: int | None


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
    if "--resume" in flags:
        for flag in flags:
            if flag not in ("--resume", *RESUMABLE):
                raise UserError(f"{flag} cannot be given with --resume; only {', '.join(RESUMABLE)} can")
    elif "--checkpoint" not in flags:
        raise UserError("flag --checkpoint is missing; give the folder of a trained agent or of a run")
    device = flags.get("--device", "auto")
    if device not in DEVICES:
        raise_unknown("device", device, DEVICES)
    settings = read_settings(DistillConfig, flags)
    paths = {
        name: Path(flags[f"--{name}"]) if f"--{name}" in flags else None for name in ("checkpoint", "out", "resume")
    }
    return DistillRequest(
        **paths,
        settings=settings,
        planner={flag.removeprefix("--planner."): flags[flag] for flag in searches if flag in flags},
        device=device,
        threads=read_threads(flags),
    )


def _distill(argv: Sequence[str]) -> int:
    if "-h" in argv or "--help" in argv:
        print(_help())
        return 0
    request = parse_arguments(argv)
    from latentplan.checkpoint import read_info

    info = read_info(request.checkpoint) if request.checkpoint is not None else {}
    planner = _planner(request, info) if request.planner else None
    device = use_device(request.device, request.threads)
    from latentplan.training import distill, resume_distillation

    if request.resume is not None:
        return resume_distillation(request.resume, device=device, **request.settings).exit_code
    assert request.checkpoint is not None
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
    out = request.out or Path("runs") / f"distilled-{info['domain']}-{info['task']}-{stamp}"
    settings = DistillConfig(**request.settings)
    return distill(request.checkpoint, out, settings, planner=planner, device=device).exit_code


def _planner(request: DistillRequest, info: dict[str, Any]) -> PlannerConfig:
    """The agent's search, with what was given in its place."""
    try:
        trained = to_dict(from_dict(info["config"]).planner)
    except ValueError as error:
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
