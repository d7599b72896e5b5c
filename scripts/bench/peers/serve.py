"""Server of a peer: a process that runs one search for each line of input and answers with its duration."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from bench.machine import read_clock
from bench.peers.problem import Problem, build_model
from latentplan.models import WorldModel

Search = Callable[[], Tensor]
MakeSearch = Callable[[Problem, WorldModel], Search]


def serve(make_search: MakeSearch) -> None:
    """Answers `{"dtype": ...}` with `{"ms": ...}`, line by line, until the input ends.

    The problem is the first argument of the command line. Output of the library goes to the error stream.

    Args:
        make_search: `make_search(problem, model) -> search`; `search()` returns the first action, (action,).
    """
    problem = Problem.from_json(sys.argv[1])
    torch.set_num_threads(problem.threads)
    torch.manual_seed(problem.seed)
    searches: dict[str, Search] = {}

    def answer(line: str) -> dict[str, Any]:
        dtype = json.loads(line)["dtype"]
        if dtype not in searches:
            searches[dtype] = make_search(problem, build_model(problem, dtype))
        return _timed(searches[dtype], problem)

    answer_lines(answer)


def answer_lines(answer: Callable[[str], dict[str, Any]]) -> None:
    """Answers each line of the input with a line of JSON; what a library prints goes to the error stream."""
    with os.fdopen(os.dup(1), "w") as answers:
        os.dup2(2, 1)
        for line in sys.stdin:
            answers.write(json.dumps(answer(line)) + "\n")
            answers.flush()


@torch.no_grad()
def _timed(search: Search, problem: Problem) -> dict[str, Any]:
    device = torch.device(problem.device)
    started = read_clock(device)
    action = search()
    elapsed = read_clock(device) - started
    if action.shape != (problem.action_dim,) or not bool(torch.isfinite(action).all()):
        raise ValueError(f"a search must return an action of shape ({problem.action_dim},), got {action}")
    return {"ms": 1000.0 * elapsed}
