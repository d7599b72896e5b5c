"""Measure the program: `python scripts/benchmark.py COMMAND [--name value ...]`; --help lists the commands."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from latentplan.commands.main import read_flags, run_guarded  # noqa: E402
from latentplan.config.files import field_names, raise_unknown  # noqa: E402

COMMANDS = {
    "train": "what an update costs, part by part, and how near it comes to what the machine can do",
    "render": "milliseconds per frame and change of the picture in each render quality",
    "decide": "milliseconds per decision of planner and actor",
    "paths": "milliseconds of every fast path of the world model beside its reference in plain torch",
    "plan": "milliseconds per search beside other planners, on the same model with the same settings",
    "compile": "milliseconds per search in small models of one's own, stepped and with compile_rollout",
    "ablate": "what each part of a trained planner earns, in paired episodes",
    "zero-shot": "goals that an agent was not trained for, pursued by planner, actor and chance",
    "realtime": "what thinking earns and costs: iterations, control rates, prediction error, re-planning",
    "soak": "deadlines that agents miss on the wall clock, beside those that the machine itself misses",
    "learn": "learning curves over tasks and seeds: frames and minutes to a return, and the final return",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one benchmark and return the exit code: 0, 2 for bad input, 130 when interrupted."""
    return run_guarded(_dispatch, sys.argv[1:] if argv is None else argv)


def _dispatch(argv: Sequence[str]) -> int:
    command = argv[0] if argv else "--help"
    if command in ("-h", "--help"):
        print("usage: benchmark.py {" + ",".join(COMMANDS) + "} [--name value ...]\n")
        print("\n".join(f"  {name:<11}{summary}" for name, summary in COMMANDS.items()))
        print("\nbenchmark.py COMMAND --help lists the flags of one.")
        return 0
    if command not in COMMANDS:
        raise_unknown("command", command, COMMANDS)
    part = importlib.import_module(f"bench.{command.replace('-', '_')}")
    if "-h" in argv or "--help" in argv:
        print(_help(command, part.FLAGS, part.SETTINGS))
        return 0
    settings = [f"--{section}.{name}" for section in part.SETTINGS for name in field_names(section)]
    code: int = part.run(read_flags(argv[1:], [*part.FLAGS, *settings]))
    return code


def _help(command: str, flags: dict[str, tuple[str, str]], sections: Sequence[str]) -> str:
    lines = [f"usage: benchmark.py {command} [--name value ...]\n", f"  {COMMANDS[command]}\n"]
    lines += [f"  {f'{flag} {metavar}':<28}{meaning}" for flag, (metavar, meaning) in flags.items()]
    if sections:
        prefixes = " ".join(f"--{section}.*" for section in sections)
        lines.append(f"\nSettings as in train.py: {prefixes}")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
