"""Scripts that make a shell complete commands, flags and values."""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from latentplan.commands.flags import list_flags
from latentplan.commands.registry import Command
from latentplan.config.parsing import alternatives, raise_unknown

SHELLS = ("bash", "zsh")


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
            argument: Any = part.add_argument(*flag.names, help=flag.help.replace("%", "%%"), choices=words or None)
            if Path in alternatives(hint):
                argument.complete = shtab.DIRECTORY if flag.metavar == "DIR" else shtab.FILE
    return str(shtab.complete(parser, shell))
