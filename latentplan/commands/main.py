"""The command `latentplan`: the table of its commands, and shell completion.

Neither torch nor lightning nor a simulator is imported before a command runs, so that `--help` and errors in flags
answer at once.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from latentplan.commands.registry import Command, call, dispatch
from latentplan.commands.shell import run_guarded

COMMANDS = {
    "train": Command("latentplan.commands.train", "learn to control a body from pixels, then evaluate and film it"),
    "eval": Command("latentplan.commands.evaluate", "play a trained agent: return, decision latency, film"),
    "distill": Command("latentplan.commands.distill", "teach a trained agent's actor to act as its planner does"),
    "goals": Command("latentplan.commands.goals", "teach a trained agent to pursue goals that are named later"),
    "export": Command("latentplan.commands.export", "write the actor as a program that runs without this package"),
    "doctor": Command("latentplan.commands.doctor", "report versions, device and renderer, and how to mend problems"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run `latentplan COMMAND ...` and return the exit code: 0, 2 for bad input, 130 when interrupted."""
    return run_guarded(_main, sys.argv[1:] if argv is None else argv)


def run_script(name: str) -> int:
    """Run the script of one command, such as `scripts/eval.py`, on its own command line; returns the exit code."""
    program = Path(sys.argv[0]).name
    return run_guarded(lambda argv: call(program, COMMANDS[name], argv), sys.argv[1:])


def _main(argv: Sequence[str]) -> int:
    if argv and argv[0].partition("=")[0] == "--print-completion":
        from latentplan.commands.completion import completion_script

        shell = argv[0].partition("=")[2] or (argv[1] if len(argv) > 1 else "")
        print(completion_script("latentplan", COMMANDS, shell))
        return 0
    code = dispatch("latentplan", COMMANDS, argv)
    if not argv or argv[0] in ("-h", "--help"):
        print('latentplan --version prints the version; eval "$(latentplan --print-completion bash)" (or zsh) makes')
        print("the shell complete commands, flags and values.")
    return code
