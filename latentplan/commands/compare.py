"""`latentplan compare RUN RUN ...`: compare training runs."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from latentplan.config import UserError
from latentplan.config.parsing import option
from latentplan.config.writing import write_whole


@dataclass(frozen=True)
class Request:
    """The command line of a comparison.

    Attributes:
        folders: Folders of two runs or more; runs that differ in their seeds alone are shown as one curve.
        report: Page with curves, settings that differ and films.
    """

    NOTES = "Intervals are Student's 95 % intervals of the mean over seeds."

    folders: tuple[Path, ...] = option(metavar="RUN", is_positional=True)
    report: Path | None = option(None, metavar="FILE.html", is_output=True)

    def __post_init__(self) -> None:
        if len(self.distinct) < 2:
            raise UserError("a comparison needs two runs or more: give their folders")

    @property
    def distinct(self) -> tuple[Path, ...]:
        """The folders in order; one that several paths name stands once, by the first path."""
        found: dict[str, Path] = {}
        for folder in self.folders:
            found.setdefault(os.path.realpath(folder), folder)
        return tuple(found.values())


def run(request: Request) -> int:
    """Print the groups of runs and the settings that differ, write the page, and return the exit code.

    Raises:
        UserError: A folder holds no run, or its files are damaged.
    """
    from latentplan.evaluation.statistics import confidence_interval
    from latentplan.reporting.compare import group_runs, render_comparison, setting_rows, summary_rows
    from latentplan.reporting.runs import format_table, read_run

    runs = [read_run(folder) for folder in request.distinct]
    groups, differ = group_runs(runs)
    print(format_table(summary_rows(groups, confidence_interval), right=range(3, 7)))
    settings = setting_rows(groups, differ)
    print()
    print(format_table(settings, right=()) if len(settings) > 1 else "all settings are the same, except seeds")
    if request.report is not None:
        write_whole(request.report, render_comparison(runs, confidence_interval))
        print(f"\nreport: {request.report}")
    return 0
