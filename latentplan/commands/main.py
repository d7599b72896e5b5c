"""The command `latentplan`: the table of its commands, and shell completion.

Neither torch nor lightning nor a simulator is imported before a command runs, so that `--help` and errors in flags
answer at once.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from latentplan import __version__
from latentplan.commands.flags import format_flags, list_flags, read_request
from latentplan.commands.shell import run_guarded
from latentplan.config.files import to_yaml
from latentplan.config.parsing import alternatives, raise_unknown

SHELLS = ("bash", "zsh")  # with completion


class Command(NamedTuple):
    """One command.

    Attributes:
        module: Dotted name of its module, which is imported when the command is called.
        summary: One sentence on what the command does.
    """

    module: str
    summary: str


COMMANDS = {
    "train": Command("latentplan.commands.train", "learn to control a body from pixels, then evaluate and film it"),
    "eval": Command("latentplan.commands.evaluate", "play a trained agent: return, decision latency, film"),
    "view": Command("latentplan.commands.view", "show an agent at work in the browser, and change its goal meanwhile"),
    "distill": Command("latentplan.commands.distill", "teach a trained agent's actor to act as its planner does"),
    "goals": Command("latentplan.commands.goals", "teach a trained agent to pursue goals that are named later"),
    "sweep": Command("latentplan.commands.sweep", "search for better settings with many short runs (Ray Tune)"),
    "runs": Command("latentplan.commands.runs", "list training runs: task, frames, minutes, returns and state"),
    "watch": Command("latentplan.commands.watch", "show the progress of a training run until it ends"),
    "compare": Command("latentplan.commands.compare", "compare training runs: curves, settings that differ, films"),
    "export": Command("latentplan.commands.export", "write the actor as a program that runs without this package"),
    "card": Command("latentplan.commands.card", "write the card of an agent, in the format of the model hub"),
    "push": Command("latentplan.commands.push", "upload an agent and its card to the model hub"),
    "pull": Command("latentplan.commands.pull", "download an agent from the model hub, and check it"),
    "envs": Command("latentplan.commands.envs", "list the environments that there are, by suite"),
    "check-env": Command("latentplan.commands.check_env", "test an environment before an agent learns in it"),
    "doctor": Command("latentplan.commands.doctor", "report versions, device and renderer, and how to mend problems"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run `latentplan COMMAND ...` and return the exit code: 0, 2 for bad input, 128 and the number of a signal."""
    return run_guarded(_main, sys.argv[1:] if argv is None else argv)


def run_script(name: str) -> int:
    """Run the script of one command, such as `scripts/eval.py`, on its own command line; returns the exit code."""
    program = Path(sys.argv[0]).name
    return run_guarded(lambda argv: call(program, COMMANDS[name], argv), sys.argv[1:])


def dispatch(program: str, commands: Mapping[str, Command], argv: Sequence[str]) -> int:
    """Call the command that the first word names and return the exit code.

    Args:
        program: How the program is called, such as `latentplan`.
        commands: The commands, by name.
        argv: The words of the command line.

    Raises:
        UserError: There is no such command, or its flags are wrong.
    """
    name = argv[0] if argv else "--help"
    if name in ("-h", "--help"):
        print(f"usage: {program} COMMAND [--name value ...]\n")
        print("\n".join(f"  {name:<11}{command.summary}" for name, command in commands.items()))
        print(f"\n{program} COMMAND --help lists the flags of a command that people use; --help-all lists every flag.")
        print("--print-config, after a command, prints its settings as YAML instead of running it.")
        return 0
    if name == "--version":
        return _print_version()
    if name not in commands:
        raise_unknown("command", name, commands)
    return call(f"{program} {name}", commands[name], argv[1:])


def call(program: str, command: Command, argv: Sequence[str]) -> int:
    """Call one command, or print its help or settings, and return the exit code.

    Args:
        program: How the command is called, such as `latentplan eval` or `eval.py`.
        command: The command.
        argv: The words after the command's name.

    Raises:
        UserError: A flag or value is wrong; the message says what to give instead.
    """
    if "--version" in argv:
        return _print_version()
    module: Any = importlib.import_module(command.module)
    if any(word in ("-h", "--help", "--help-all") for word in argv):
        print(format_flags(module.Request, program, command.summary, "--help-all" in argv), end="")
        return 0
    request = read_request(module.Request, [word for word in argv if word != "--print-config"])
    if "--print-config" in argv:
        print(to_yaml(module.resolve(request) if hasattr(module, "resolve") else request), end="")
        return 0
    code: int = module.run(request)
    return code


def completion_script(program: str, commands: Mapping[str, Command], shell: str) -> str:
    """The script that makes a shell complete a program, its commands and their flags.

    Args:
        program: Name of the program.
        commands: Its commands, by name.
        shell: `bash` or `zsh`.

    Raises:
        UserError: The shell is another one.
    """
    if shell not in SHELLS:
        raise_unknown("shell", shell, SHELLS)
    import shtab

    parser = argparse.ArgumentParser(prog=program)
    parser.add_argument("--version", action="store_true", help="print the version")
    parser.add_argument("--print-completion", choices=SHELLS, help="print the script that completes this program")
    parts = parser.add_subparsers()
    for name, command in commands.items():
        part = parts.add_parser(name, help=command.summary)
        for word, meaning in (("--help-all", "print every flag"), ("--print-config", "print the settings as YAML")):
            part.add_argument(word, action="store_true", help=meaning)
        for flag in list_flags(importlib.import_module(command.module).Request):
            hint = flag.setting.hint
            words = ("true", "false") if hint is bool else flag.setting.choices
            dest = (flag.setting.key,) if flag.is_positional else flag.names
            argument: Any = part.add_argument(*dest, help=flag.help.replace("%", "%%"), choices=words or None)
            if Path in alternatives(hint):
                argument.complete = shtab.DIRECTORY if flag.metavar == "DIR" else shtab.FILE
    return str(shtab.complete(parser, shell))


def _main(argv: Sequence[str]) -> int:
    if argv and argv[0].partition("=")[0] == "--print-completion":
        shell = argv[0].partition("=")[2] or (argv[1] if len(argv) > 1 else "")
        print(completion_script("latentplan", COMMANDS, shell))
        return 0
    code = dispatch("latentplan", COMMANDS, argv)
    if not argv or argv[0] in ("-h", "--help"):
        print('latentplan --version prints the version; eval "$(latentplan --print-completion bash)" (or zsh) makes')
        print("the shell complete commands, flags and values.")
    return code


def _print_version() -> int:
    print(f"latentplan {__version__}")
    return 0
