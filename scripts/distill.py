"""Teach a trained agent's actor to act as its planner does: `python scripts/distill.py --checkpoint DIR`."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from latentplan.commands.main import run_script  # noqa: E402

if __name__ == "__main__":
    sys.exit(run_script("distill"))
