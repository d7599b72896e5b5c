"""Published returns of training from pixels, to compare with the learning curves of this project.

Episode returns of `dm_control.suite`, at most 1,000; frames are simulator control steps, before action repeat.
`published.csv` holds them: the mean over seeds, the number of seeds and their standard deviation where they are known,
and the source. DreamerV3 (its returns are those of training episodes), MR.Q, DR.Q, TD-MPC2, DrQ-v2 and CURL were read
from result files in public repositories, EfficientZero V2 off a figure. The methods that are marked `own repeat` have
the action repeat of `configs/`, and come from the tables of ResAct (2025) and COVR (2026).
"""

from __future__ import annotations

import csv
import functools
from collections.abc import Mapping
from pathlib import Path

PUBLISHED = Path(__file__).with_name("published.csv")
FRAMES = (100_000, 200_000, 500_000, 1_000_000)
METHODS_AT_REPEAT_2 = ("DreamerV3", "MR.Q", "DR.Q", "TD-MPC2", "DrQ-v2", "CURL", "EfficientZero V2")
METHODS = (
    *METHODS_AT_REPEAT_2,
    *(f"{name} (own repeat)" for name in ("PlaNet", "Dreamer", "CURL", "DrQ", "ResAct", "COVR")),
)


def published_returns_of(task: str) -> dict[str, Mapping[int, float]]:
    """Mean return of each method on a task `domain-name`, by env frames; empty for a task without published returns.

    The mark `own repeat` stands at methods with the action repeat of the project's `configs/` instead of 2.
    """
    known = _read_published().get(task, {})
    return {method: known[method] for method in METHODS if method in known}


@functools.cache
def _read_published() -> dict[str, dict[str, dict[int, float]]]:
    """Mean returns by task, method and env frames."""
    found: dict[str, dict[str, dict[int, float]]] = {}
    with PUBLISHED.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            means = found.setdefault(row["task"], {}).setdefault(row["method"], {})
            means[int(row["frames"])] = float(row["mean"])
    return found
