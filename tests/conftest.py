"""Fixtures and process settings of all tests."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# Models here are tiny: threads gain nothing and wait for each other on a busy machine. Torch reads this at import.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# A fixed budget and a fixed order of examples in `make test`; `make fuzz` draws new ones for long.
LIBERAL = {"deadline": None, "suppress_health_check": list(HealthCheck)}
settings.register_profile("test", max_examples=40, derandomize=True, database=None, **LIBERAL)
settings.register_profile("fuzz", max_examples=5000, print_blob=True, **LIBERAL)
settings.load_profile("test")

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def root():
    """The folder of the checkout."""
    return ROOT


@pytest.fixture(scope="session")
def run_python():
    """Run a Python program in a fresh interpreter that sees the checkout; returns the finished process."""

    def run(*arguments, cwd=ROOT, timeout=120):
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        command = [sys.executable, *map(str, arguments)]
        return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=timeout)

    return run


# A shell starts background jobs with Ctrl-C ignored, and their children inherit it: tests of interruption must not.
signal.signal(signal.SIGINT, signal.default_int_handler)
