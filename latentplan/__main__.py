"""`python -m latentplan`: train, eval, distill, export, doctor and --version."""

from __future__ import annotations

import sys

from latentplan.commands.main import main

if __name__ == "__main__":
    sys.exit(main())
