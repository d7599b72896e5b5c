"""The flags that `latentplan distill` and `latentplan goals` share."""

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
    """The command line of teaching a trained agent: the agent, the output folder, or a folder to resume.

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
    """The default folder of an agent that is taught: `runs/<kind>-<domain>-<task>-<date>`.

    Args:
        kind: First word of the name, such as `distilled`.
        info: Content of the `info.json` of the agent.
    """
    return Path("runs") / f"{kind}-{info['domain']}-{info['task']}-{datetime.now():%Y%m%d-%H%M%S}"
