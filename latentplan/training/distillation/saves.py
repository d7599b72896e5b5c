"""What a distillation saves, and continues with."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from latentplan.agents.checkpoint import read_info
from latentplan.config import DistillConfig, PlannerConfig, UserError, from_dict
from latentplan.config.commit import Saves
from latentplan.config.run_folder import DISTILLATION, SAVES_FOLDER, require_saves
from latentplan.training.distillation.student import StudentState
from latentplan.training.state import build_settings, load_values

KIND, FORMAT = DISTILLATION, 2
SAVED = {
    "source": str,
    "sha256": str,
    "settings": dict[str, Any],
    "planner": dict[str, Any],
    "state": dict[str, Any],
    "demonstrations": dict[str, torch.Tensor],
    "student": StudentState,
    "best": dict[str, torch.Tensor],
}
"""The types of what a save of a distillation holds."""


def read_resumed(
    folder: Path | str, *, rounds: int | None = None, minutes: float | None = None
) -> tuple[dict[str, Any], DistillConfig, PlannerConfig]:
    """What a distillation continues with: its last save, its settings and those of its search.

    Args:
        folder: As for `resume_distillation`, and so are the others.
        rounds: New total number of rounds.
        minutes: New total budget of minutes.

    Raises:
        UserError: The folder holds no distillation, or the agent that it started from has changed.
    """
    require_saves(Path(folder), KIND)
    saved = _load_distillation(Path(folder))
    if read_info(saved["source"])["sha256"] != saved["sha256"]:
        raise UserError(f"{saved['source']} is not the agent from which the distillation in {folder} started")
    settings = build_settings(DistillConfig, saved["settings"], Path(folder))
    settings = replace(settings, rounds=rounds or settings.rounds, minutes=minutes or settings.minutes)
    try:
        planner = from_dict({"planner": saved["planner"]}).planner
    except ValueError as error:
        raise UserError(f"the last save in {folder} is damaged: {error}") from None
    return saved, settings, planner


def open_saves(folder: Path) -> Saves:
    """The saves of a distillation in its folder."""
    return Saves(folder / SAVES_FOLDER, KIND, FORMAT)


def _load_distillation(folder: Path) -> dict[str, Any]:
    """The distillation saved in a folder.

    Raises:
        UserError: The folder holds no distillation, or a damaged one, or one of an earlier version.
    """
    if (folder / SAVES_FOLDER / "distill.pt").exists():
        raise UserError(
            f"{folder} was saved by latentplan 0.2.0 or earlier: finish it with that version, or start anew"
        )
    return load_values(open_saves(folder), SAVED)
