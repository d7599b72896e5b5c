"""Measures the program: `python scripts/benchmark.py COMMAND [--name value ...]`; --help lists the commands."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from latentplan.commands.main import Command, dispatch
from latentplan.commands.shell import run_guarded  # noqa: E402

COMMANDS = {
    "train": Command("bench.train", "time of each part of an update, beside the peak FLOP/s of the machine"),
    "render": Command("bench.render", "milliseconds per frame and change of the picture in each render quality"),
    "collect": Command("bench.collect", "frames per second of several workers, and what a cluster of them would do"),
    "decide": Command("bench.decide", "milliseconds per decision of planner, actor and exported actor"),
    "paths": Command("bench.paths", "milliseconds of every fast path of the world model beside plain torch"),
    "plan": Command("bench.plan", "milliseconds per search beside other planners, on the same model and settings"),
    "search": Command("bench.search", "cost that planners of this and other libraries reach in closed loop"),
    "compile": Command("bench.compile", "milliseconds per search in small models, stepped and with compile_rollout"),
    "ablate": Command("bench.ablate", "return of a trained planner without each of its parts, in paired episodes"),
    "zero-shot": Command("bench.zero_shot", "goals that an agent was not trained for: planner, actor, random actions"),
    "realtime": Command("bench.realtime", "return and time by iterations, control rates, prediction and re-planning"),
    "view": Command("bench.view", "decisions per second of the live view while a page is open in headless Chromium"),
    "soak": Command("bench.soak", "deadlines that agents and an idle loop miss on the wall clock"),
    "faults": Command("bench.faults", "a run that is killed, filled, corrupted and poisoned once a minute"),
    "survive": Command("bench.survive", "kills, kills within a save and flipped bits: tries and survivals"),
    "saving": Command("bench.saving", "share of the time of a training run that saves and guards take"),
    "hostile": Command(
        "bench.hostile", "hostile command lines and files: refused in one line, and in how many seconds"
    ),
    "learn": Command("bench.learn", "learning curves over tasks and seeds: frames and minutes to a return"),
    "suite": Command("bench.suite", "many tasks and seeds beside published returns, over any number of interruptions"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one benchmark and returns the exit code: 0, 2 for bad input, 130 when interrupted."""
    words = sys.argv[1:] if argv is None else argv
    return run_guarded(lambda argv: dispatch("benchmark.py", COMMANDS, argv), words)


if __name__ == "__main__":
    sys.exit(main())
