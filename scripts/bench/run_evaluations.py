"""Evaluations of training runs that may have been extended.

A run has one final evaluation, in `final.json`, and an extension of the run replaces it. `finals.json` in the folder of
the run keeps the final evaluations of its shorter budgets.
"""

from __future__ import annotations

from pathlib import Path

from bench.report import write_json
from latentplan.config import UserError
from latentplan.config.run_results import FINAL_FILE, Evaluation, moment_of, read_evaluations, read_facts, read_log

FINALS = "finals.json"


def keep_final(folder: Path) -> None:
    """Copies the final evaluation of a run, if it has one, before a process starts that may replace it.

    Raises:
        UserError: The copy cannot be written, or the file of copies is damaged.
    """
    final = read_log({"metrics": [read_facts(folder, FINAL_FILE)]})
    if final:
        kept = {moment_of(each): each for each in (*_read_finals(folder), *final)}
        write_json(folder / FINALS, {"metrics": [each._asdict() for each in kept.values()]})


def read_all_evaluations(folder: Path) -> list[Evaluation]:
    """The evaluations of a run, in the order of their frames; empty before the first.

    A final evaluation, also one of a shorter budget, takes the place of another evaluation at the same frames.

    Raises:
        UserError: The files of the run are damaged.
    """
    evaluations = read_evaluations(folder)
    if not evaluations:
        return []
    found = {moment_of(each): each for each in evaluations}
    found |= {moment_of(each): each for each in _read_finals(folder) if moment_of(each) < moment_of(evaluations[-1])}
    return [found[moment] for moment in sorted(found)]


def _read_finals(folder: Path) -> list[Evaluation]:
    facts = read_facts(folder, FINALS)
    if not facts and (folder / FINALS).exists():
        raise UserError(f"{folder / FINALS} is damaged; remove it, and with it the results of shorter budgets")
    return read_log(facts)
