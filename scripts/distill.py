"""Teach a trained agent's actor what its planner does: `python scripts/distill.py --checkpoint DIR`; see --help."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from latentplan.commands.distill import main  # noqa: E402

if __name__ == "__main__":
    sys.exit(main())
