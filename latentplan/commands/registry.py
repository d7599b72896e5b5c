"""Commands by name: how a table of commands is called.

A command is a module with a dataclass `Request`, whose fields are the flags, and a function `run`, which takes a
request and returns the exit code. A module may have a function `resolve`, which takes a request and returns the
settings that `--print-config` prints; without `resolve` the request itself is printed.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from latentplan import __version__
from latentplan.commands.flags import format_flags, read_request
from latentplan.config.files import to_yaml
from latentplan.config.parsing import raise_unknown


class Command(NamedTuple):
    """One command.

    Attributes:
        module: Dotted name of its module, which is imported when the command is called.
        summary: One sentence on what the command does.
    """

    module: str
    summary: str


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


def _print_version() -> int:
    print(f"latentplan {__version__}")
    return 0
