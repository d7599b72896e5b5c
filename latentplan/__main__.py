"""`python -m latentplan COMMAND ...` does the same as `latentplan COMMAND ...`."""

from __future__ import annotations

import sys

from latentplan.commands.main import main

if __name__ == "__main__":
    sys.exit(main())
