"""Where a distillation stands, and how it is written down and picked up again."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from latentplan.config import UserError, make_folder
from latentplan.replay.buffer import read_saved

STATE_FILE = Path("resume") / "distill.pt"
START = -1  # stands for a round where the actor is the one it all began with


@dataclass
class Standing:
    """What a distillation has done and found.

    Attributes:
        stage: Stages done, three to a round.
        minutes: Wall clock spent, over all processes.
        decisions: Decisions driven.
        loss: Mean imitation loss over the last round's updates, in nats.
        best_return: Mean return of the best actor on the starts that choose between rounds.
        best_round: The round that made it; -1 for the actor it all began with.
        before: Returns of that first actor on the starts that judge.
        planner: Returns of the planner on these; with them the beginning is done.
    """

    stage: int = 0
    minutes: float = 0.0
    decisions: int = 0
    loss: float = float("nan")
    best_return: float = float("-inf")
    best_round: int = START
    before: list[float] = field(default_factory=list)
    planner: list[float] = field(default_factory=list)


def save_distillation(folder: Path, saved: dict[str, Any]) -> None:
    """Write everything that going on takes; replaced whole."""
    path = folder / STATE_FILE
    make_folder(path.parent)
    part = path.with_suffix(".part")
    torch.save(saved, part)
    part.replace(path)


def load_distillation(folder: Path) -> dict[str, Any]:
    """What `save_distillation` wrote.

    Raises:
        UserError: The folder holds no distillation, or a damaged one.
    """
    path = folder / STATE_FILE
    if not path.is_file():
        raise UserError(f"nothing to resume in {folder}: {path} is missing")
    saved: dict[str, Any] = read_saved(path)
    return saved
