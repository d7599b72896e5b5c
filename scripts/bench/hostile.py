"""`benchmark.py hostile`: hostile command lines and files, each in a program of its own, and the time until refusal."""

from __future__ import annotations

import dataclasses
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from bench.hostile_inputs import MARK, list_cases, write_files
from bench.report import format_number, format_table, write_json
from latentplan.config import UserError
from latentplan.config.checks import LONGEST_LINE, at_least, shown
from latentplan.config.parsing import option

ROOT = Path(__file__).resolve().parents[2]
TIMEOUT_S = 120
PROMISED_S = 2.0


@dataclass(frozen=True)
class Request:
    """Flags of `benchmark.py hostile`.

    Attributes:
        checkpoint: Folder of a trained agent, of which damaged copies are made.
        only: Part of the names of the inputs that are tried; empty tries all.
        every: Tries every n-th input only.
        json: Result as JSON.
    """

    checkpoint: Path = option(Path("checkpoints/cartpole-swingup"), metavar="DIR")
    only: str = ""
    every: int = 1
    json: Path | None = option(None, metavar="FILE", is_output=True)

    def __post_init__(self) -> None:
        at_least(self, every=1)


@dataclass(frozen=True)
class Outcome:
    """How one input ended.

    Attributes:
        case: Name of the input.
        problem: What was not as it should be; empty if nothing.
        seconds: Time of the clock.
        processor_seconds: Time of the processor, which says more than the clock on a busy machine.
        output: The end of stderr.
        length: Characters of stderr.
    """

    case: str
    problem: str
    seconds: float
    processor_seconds: float
    output: str = ""
    length: int = 0


def run(request: Request) -> int:
    """Tries the inputs, prints those that were not refused as they should be, and returns 1 if there are any.

    Raises:
        UserError: No input has such a name.
    """
    agent, outcomes = request.checkpoint.resolve(), []
    cases = [case for case in list_cases().items() if request.only in case[0]][:: request.every]
    if not cases:
        raise UserError(f"--only {shown(request.only)} is part of no input's name")
    with tempfile.TemporaryDirectory() as name:
        write_files(Path(name), agent)
        for case, words in cases:
            argv = [word.replace("{folder}", name).replace("{agent}", str(agent)) for word in words]
            outcomes.append(try_input(case, argv, Path(name)))
            if outcomes[-1].problem:
                print(f"{case}: {outcomes[-1].problem}: {outcomes[-1].output}", flush=True)
    seconds, busy = [outcome.seconds for outcome in outcomes], [outcome.processor_seconds for outcome in outcomes]
    wrong = [outcome for outcome in outcomes if outcome.problem]
    rows = [
        ["inputs", str(len(outcomes))],
        [f"refused in one line within {PROMISED_S:g} s, none executed", str(len(outcomes) - len(wrong))],
        ["seconds of the clock, median and largest", _spread(seconds)],
        ["seconds of the processor, median and largest", _spread(busy)],
        ["longest line", str(max(outcome.length for outcome in outcomes))],
    ]
    print(format_table(["hostile inputs", ""], rows))
    write_json(request.json, {"outcomes": [dataclasses.asdict(outcome) for outcome in outcomes]})
    return 1 if wrong else 0


def try_input(case: str, argv: list[str], folder: Path) -> Outcome:
    """The outcome of one command line in a program of its own.

    Args:
        case: Name of the input.
        argv: The words of the command line.
        folder: Folder of the files, in which nothing may be executed.
    """
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "latentplan", *argv]
    (folder / MARK).unlink(missing_ok=True)
    started, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    try:
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, timeout=TIMEOUT_S, check=False)
    except subprocess.TimeoutExpired:
        return Outcome(case, "it does not end", float(TIMEOUT_S), 0.0)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    busy = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    error = done.stderr.decode(errors="replace")
    problem = judge(done.returncode, done.stdout.decode(errors="replace"), error)
    if (folder / MARK).exists():
        problem = "it was executed"
    elif not problem and busy > PROMISED_S:
        problem = f"{busy:.1f} s of the processor"
    return Outcome(case, problem, time.perf_counter() - started, busy, error[-300:], len(error))


def judge(code: int, output: str, error: str) -> str:
    """What was not as it should be in the refusal of an input; empty if nothing.

    Args:
        code: Exit code.
        output: What was written to stdout.
        error: What was written to stderr.
    """
    if code != 2:
        return f"exit code {code}"
    if output:
        return f"{len(output)} characters of output"
    if error.count("\n") != 1 or not error.startswith("error: "):
        return "not one line"
    return f"a line of {len(error)} characters" if len(error) > LONGEST_LINE else ""


def _spread(values: list[float]) -> str:
    return f"{format_number(statistics.median(values), 2)} {format_number(max(values), 2)}"
