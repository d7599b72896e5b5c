"""The settings that a checkpoint was saved with, and the changes that a command line makes to them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from latentplan.config import Config, PlannerConfig, UserError, from_dict, to_dict
from latentplan.config.files import build_config
from latentplan.config.planner import override_planner


def saved_config(checkpoint: Path, info: Mapping[str, Any]) -> Config:
    """The settings of a checkpoint.

    Args:
        checkpoint: Folder of the checkpoint, which an error names.
        info: Content of its `info.json`.

    Raises:
        UserError: The settings are those of an incompatible version.
    """
    try:
        return from_dict(info["config"])
    except (AttributeError, TypeError, ValueError) as error:
        raise UserError(f"{checkpoint} has settings of another version: {error}") from None


def search_settings(saved: PlannerConfig, given: Mapping[str, Any]) -> PlannerConfig:
    """The settings of a checkpoint's search with the given ones in their place.

    Raises:
        UserError: A given value is not allowed beside the saved ones.
    """
    return build_config({"planner": override_planner(to_dict(saved), given)}).planner
