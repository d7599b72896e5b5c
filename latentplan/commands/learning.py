"""What the commands that teach a trained agent have in common."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from latentplan.commands.shell import ComputeRequest
from latentplan.config import UserError
from latentplan.config.parsing import option


@dataclass(frozen=True, kw_only=True)
class LearningRequest(ComputeRequest):
    """What the command line of teaching a trained agent asks for.

    Attributes:
        checkpoint: Folder of a trained agent, or of a run (its best checkpoint).
        out: Folder of the agent that has learned; None makes one under `runs`, named by agent, task and date.
        resume: Folder of the learning to continue.
    """

    checkpoint: Path | None = option(None, metavar="DIR")
    out: Path | None = option(None, metavar="DIR")
    resume: Path | None = option(None, metavar="DIR")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.checkpoint is None and self.resume is None:
            raise UserError("flag --checkpoint is missing; give the folder of a trained agent or of a run")


def name_folder(kind: str, info: Mapping[str, Any]) -> Path:
    """The folder of an agent that learns, unless another one is given: `runs/<kind>-<domain>-<task>-<date>`."""
    return Path("runs") / f"{kind}-{info['domain']}-{info['task']}-{datetime.now():%Y%m%d-%H%M%S}"
