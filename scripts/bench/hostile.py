"""`benchmark.py hostile`: hostile command lines and files, each in a program of its own, and the time until refusal."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from bench.hostile_inputs import MARK, list_cases, write_files
from bench.report import format_number, format_table, write_json
from latentplan.config.parsing import option

ROOT = Path(__file__).resolve().parents[2]
TIMEOUT_S = 60
LONGEST_LINE = 400


@dataclass(frozen=True)
class Request:
    """Flags of `benchmark.py hostile`.

    Attributes:
        checkpoint: Folder of a trained agent, of which damaged copies are made.
        only: Part of the names of the inputs that are tried; empty tries all.
        json: Result as JSON.
    """

    checkpoint: Path = option(Path("checkpoints/cartpole-swingup"), metavar="DIR")
    only: str = ""
    json: Path | None = option(None, metavar="FILE", is_output=True)


def run(request: Request) -> int:
    """Tries every input, prints those that were not refused as they should be, and returns 1 if there are any."""
    results = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_files(folder, request.checkpoint.resolve())
        for case, words in list_cases().items():
            if request.only in case:
                argv = [word.replace("{folder}", name).replace("{agent}", str(request.checkpoint)) for word in words]
                results.append({"case": case, **try_input(argv, folder)})
                if results[-1]["problem"]:
                    print(f"{case}: {results[-1]['problem']}: {results[-1]['output']}", flush=True)
    seconds = sorted(result["seconds"] for result in results)
    wrong = [result for result in results if result["problem"]]
    rows = [
        ["inputs", str(len(results))],
        ["refused in one line, none executed", str(len(results) - len(wrong))],
        ["seconds, median", format_number(seconds[len(seconds) // 2], 2)],
        ["seconds, largest", format_number(seconds[-1], 2)],
        ["over 2 s", str(sum(second > 2.0 for second in seconds))],
        ["longest line", str(max(result["length"] for result in results))],
    ]
    print(format_table(["hostile inputs", ""], rows))
    write_json(request.json, {"results": results})
    return 1 if wrong else 0


def try_input(argv: list[str], folder: Path) -> dict[str, object]:
    """The outcome of one command line: exit code, seconds, length of the line, and the problem, empty if none."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "latentplan", *argv]
    started = time.perf_counter()
    try:
        done = subprocess.run(
            command, cwd=folder.parent, env=environment, capture_output=True, timeout=TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return {"code": None, "seconds": float(TIMEOUT_S), "length": 0, "output": "", "problem": "it does not end"}
    seconds = time.perf_counter() - started
    output = done.stderr.decode(errors="replace")
    problem = ""
    if done.returncode != 2 or done.stdout:
        problem = f"exit code {done.returncode}"
    elif output.count("\n") != 1 or not output.startswith("error: "):
        problem = "not one line"
    elif len(output) > LONGEST_LINE:
        problem = f"a line of {len(output)} characters"
    elif (folder / MARK).exists():
        problem = "it was executed"
    return {
        "code": done.returncode,
        "seconds": seconds,
        "length": len(output),
        "output": output[-300:],
        "problem": problem,
    }
