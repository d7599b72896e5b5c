"""`latentplan export`: write the actor as a program that maps frame, belief and last action to action and belief."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from latentplan.config.parsing import option


@dataclass(frozen=True)
class Request:
    """The command line of an export.

    Attributes:
        checkpoint: Folder of a trained agent, or of a run (its best checkpoint).
        out: File to write.
        format: `pt2` is a program of `torch.export`; `onnx` needs the packages onnx and onnxscript.
    """

    checkpoint: Path = option(metavar="DIR")
    out: Path = option(metavar="FILE")
    format: Literal["pt2", "onnx"] = "pt2"


def run(request: Request) -> int:
    """Write the program, print its size and return the exit code."""
    from latentplan.agents.info import read_info

    read_info(request.checkpoint)  # refuses a damaged agent before torch is imported
    from latentplan.agents.export import export_actor

    path = export_actor(request.checkpoint, request.out, request.format)
    print(f"wrote {path} ({path.stat().st_size / 2**20:.1f} MiB)")
    return 0
