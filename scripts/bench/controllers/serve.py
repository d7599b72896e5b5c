"""Server of a library's planners: a process that plays closed loops, and times single decisions, on request."""

from __future__ import annotations

import json
import random
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

import torch

from bench.controllers.task import Act, Task, find_problem
from bench.peers.serve import answer_lines

MakeController = Callable[[Task, Sequence[int]], Act]


class Entry(NamedTuple):
    """A planner of a library.

    Attributes:
        make: `make(task, seeds) -> act`, a fresh controller of one environment per seed.
        is_batched: Whether `make` takes several seeds at once; otherwise it gets one.
        choices: Settings between which the benchmark may choose for each problem.
    """

    make: MakeController
    is_batched: bool = False
    choices: tuple[dict[str, Any], ...] = ({},)


def serve(planners: Mapping[str, Entry]) -> None:
    """Answers requests, line by line, until the input ends.

    `{"do": "list"}` is answered by the planners and their choices; `{"do": "run", ...}` by the total cost of each
    seed and the evaluations per decision; `{"do": "time", ...}` by the milliseconds of the next decision of a loop that
    goes on between requests; a request that fails by `{"error": ...}`. Output of the library goes to the error stream.

    Args:
        planners: The planners of the library, by name.
    """
    torch.set_num_threads(int(sys.argv[1]))
    loops: dict[str, Iterator[float]] = {}

    def answer(line: str) -> dict[str, Any]:
        try:
            return _answer(planners, line, loops)
        except Exception as error:
            return {"error": " ".join(f"{type(error).__name__}: {error}".split())[:300]}

    answer_lines(answer)


def _answer(planners: Mapping[str, Entry], line: str, loops: dict[str, Iterator[float]]) -> dict[str, Any]:
    request = json.loads(line)
    if request["do"] == "list":
        return {"planners": {name: list(entry.choices) for name, entry in planners.items()}}
    entry = planners[request["planner"]]
    if request["do"] == "run":
        return play(entry, _task(request), request["seeds"])
    if line not in loops:
        loops[line] = _decisions(entry, request)
    return {"ms": next(loops[line])}


def play(entry: Entry, task: Task, seeds: Sequence[int]) -> dict[str, Any]:
    """The total cost of each seed, and the evaluated sequences per decision."""
    costs: list[float] = []
    for group in [seeds] if entry.is_batched else [[seed] for seed in seeds]:
        _seed_global_streams(group[0])
        costs += task.problem.run(entry.make(task, group), group).tolist()
    decisions = len(seeds) * task.problem.num_steps
    return {"costs": costs, "evaluations": task.rows / (decisions * task.problem.horizon)}


def _decisions(entry: Entry, request: dict[str, Any]) -> Iterator[float]:
    """Yields the milliseconds of each decision of runs that follow each other."""
    # The processor time of one thread does not count the work of other programs on a busy machine.
    clock = time.thread_time if torch.get_num_threads() == 1 else time.perf_counter
    seed, task = 0, _task(request)
    problem = task.problem
    while True:
        with torch.no_grad():
            act, state = entry.make(task, [seed]), problem.start([seed])
        for _ in range(problem.num_steps):
            with torch.no_grad():
                started = clock()
                action = act(state)
                elapsed = clock() - started
                state = problem.dynamics(state, action)
            yield 1000.0 * elapsed
        seed += 1


def _task(request: dict[str, Any]) -> Task:
    problem = _cached_problem(request["problem"])
    return Task(
        problem=problem,
        samples=request["samples"],
        iterations=request["iterations"],
        settings=request.get("settings", {}),
    )


_cached_problem = cache(find_problem)


def _seed_global_streams(seed: int) -> None:
    """Seeds every global random stream; some libraries draw from NumPy's."""
    import numpy as np

    torch.manual_seed(seed)
    np.random.seed(seed)
    random.seed(seed)
