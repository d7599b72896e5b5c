"""Train an agent from pixels: `python scripts/train.py --domain walker`; --help lists every setting."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from latentplan.commands.main import train_main  # noqa: E402

if __name__ == "__main__":
    sys.exit(train_main())
