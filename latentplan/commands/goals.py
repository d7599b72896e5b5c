"""`scripts/goals.py`: a trained agent, taught to pursue goals that are named later.

Torch is imported when it is needed, so that `--help` and bad input answer at once.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from latentplan.commands.flags import (
    COMMON_FLAGS,
    LearningRequest,
    describe_settings,
    name_folder,
    read_request,
    setting_kinds,
)
from latentplan.commands.main import read_flags, run_guarded, use_device
from latentplan.config import GoalsConfig

FLAGS = {
    "--checkpoint": ("DIR", "folder of a run, whose replay is learned from, or of an agent, which then plays a while"),
    "--out": ("DIR", "folder of the agent that knows goals (runs/goals-<domain>-<task>-<date>)"),
    **COMMON_FLAGS,
}
RESUMABLE = ("--updates", "--minutes", "--device", "--threads")


def main(argv: Sequence[str] | None = None) -> int:
    """Run `scripts/goals.py` and return the exit code: 0, 2 for bad input, 130 when interrupted."""
    return run_guarded(learn, sys.argv[1:] if argv is None else argv)


def parse_arguments(argv: Sequence[str]) -> LearningRequest:
    """Read the command line.

    Raises:
        UserError: A flag or value is wrong; the message says what to give.
    """
    return read_request(GoalsConfig, read_flags(argv, [*FLAGS, *setting_kinds(GoalsConfig)]), RESUMABLE)


def learn(argv: Sequence[str]) -> int:
    """Run the command and return its exit code.

    Raises:
        UserError: A flag, the run or a folder cannot be used.
    """
    if "-h" in argv or "--help" in argv:
        print(_help())
        return 0
    request = parse_arguments(argv)
    from latentplan.agents.checkpoint import read_info

    info = read_info(request.checkpoint) if request.checkpoint is not None else {}
    device = use_device(request.device, request.threads)
    from latentplan.training import learn_goals, resume_goals

    if request.resume is not None:
        return resume_goals(request.resume, device=device, **request.settings).exit_code
    assert request.checkpoint is not None
    out = request.out or name_folder("goals", info)
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
