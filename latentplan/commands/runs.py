"""`latentplan runs [DIR]`: list training runs."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from latentplan.config.parsing import option


@dataclass(frozen=True)
class Request:
    """The command line of the list.

    Attributes:
        folder: Folder that holds runs, or a run.
    """

    NOTES = "`best` and `last` are mean returns of the planner in evaluations."

    folder: Path = option(Path("runs"), metavar="DIR", is_positional=True)


def run(request: Request) -> int:
    """Print the table; one line on stderr for each folder that is no run.

    Raises:
        UserError: There is no such folder.
    """
    from latentplan.reporting.runs import find_runs, format_runs

    runs, problems = find_runs(request.folder)
    if runs:
        print(format_runs(runs, request.folder), flush=True)
    for problem in problems:
        print(f"no run: {problem}", file=sys.stderr)
    if not runs and not problems:
        print(f"no run in {request.folder}")
    return 0
