"""`scripts/goals.py`: a trained agent, taught to pursue goals that are named later.

Torch is imported when it is needed, so that `--help` and bad input answer at once.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from latentplan.cli import read_flags, run_guarded, use_device
from latentplan.compose import raise_unknown
from latentplan.config import DEVICES, GoalsConfig, UserError
from latentplan.setting_flags import describe_settings, read_settings, read_threads, setting_kinds

FLAGS = {
    "--checkpoint": ("DIR", "folder of a run, whose replay is learned from, or of an agent, which then plays a while"),
    "--out": ("DIR", "folder of the agent that knows goals (runs/goals-<domain>-<task>-<date>)"),
    "--resume": ("DIR", "go on with the learning in this folder"),
    "--device": ("|".join(DEVICES), "where the agent computes (auto: cuda where usable)"),
    "--threads": ("N", "CPU threads (torch's own choice)"),
}
RESUMABLE = ("--updates", "--minutes", "--device", "--threads")


@dataclass(frozen=True)
class GoalsRequest:
    """What the command line asks for.

    Attributes:
        checkpoint: Folder of the run or the agent to begin with; None when a learning resumes.
        out: Where the agent goes, or None for a folder of its own under `runs`.
        resume: Folder of the learning to go on with, or None.
        settings: Fields of `GoalsConfig` that were given.
        device: `auto`, `cpu` or `cuda`.
        threads: CPU threads, or None to leave it to torch.
    """

    checkpoint: Path | None
    out: Path | None
    resume: Path | None
    settings: dict[str, Any]
    device: str
    threads: int | None


def main(argv: Sequence[str] | None = None) -> int:
    """Run `scripts/goals.py` and return the exit code: 0, 2 for bad input, 130 when interrupted."""
    return run_guarded(learn, sys.argv[1:] if argv is None else argv)


def parse_arguments(argv: Sequence[str]) -> GoalsRequest:
    """Read the command line.

    Raises:
        UserError: A flag or value is wrong; the message says what to give.
    """
    flags = read_flags(argv, [*FLAGS, *setting_kinds(GoalsConfig)])
    if "--resume" in flags:
        for flag in flags:
            if flag not in ("--resume", *RESUMABLE):
                raise UserError(f"{flag} cannot be given with --resume; only {', '.join(RESUMABLE)} can")
    elif "--checkpoint" not in flags:
        raise UserError("flag --checkpoint is missing; give the folder of a run or of a trained agent")
    device = flags.get("--device", "auto")
    if device not in DEVICES:
        raise_unknown("device", device, DEVICES)
    paths = {
        name: Path(flags[f"--{name}"]) if f"--{name}" in flags else None for name in ("checkpoint", "out", "resume")
    }
    return GoalsRequest(**paths, settings=read_settings(GoalsConfig, flags), device=device, threads=read_threads(flags))


def learn(argv: Sequence[str]) -> int:
    """Run the command and return its exit code.

    Raises:
        UserError: A flag, the run or a folder cannot be used.
    """
    if "-h" in argv or "--help" in argv:
        print(_help())
        return 0
    request = parse_arguments(argv)
    from latentplan.checkpoint import read_info

    info = read_info(request.checkpoint) if request.checkpoint is not None else {}
    device = use_device(request.device, request.threads)
    from latentplan.training import learn_goals, resume_goals

    if request.resume is not None:
        return resume_goals(request.resume, device=device, **request.settings).exit_code
    assert request.checkpoint is not None
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
    out = request.out or Path("runs") / f"goals-{info['domain']}-{info['task']}-{stamp}"
    return learn_goals(request.checkpoint, out, GoalsConfig(**request.settings), device=device).exit_code


def _help() -> str:
    """Flags with their meanings."""
    rows = [(f"{flag} {metavar}", meaning) for flag, (metavar, meaning) in FLAGS.items()]
    lines = "\n".join(f"  {flag:<24}{meaning}" for flag, meaning in rows + describe_settings(GoalsConfig))
    return (
        "usage: goals.py --checkpoint DIR [--name value ...]\n\n"
        "Teach a trained agent to pursue goals that are named later; nothing else about it changes.\n"
        f"With --resume only {', '.join(RESUMABLE)} may be given.\n\n{lines}"
    )
