"""Output that nobody reads to its end, as in `train.py --help | head`."""

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"


@pytest.mark.parametrize("words", [["train.py", "--help"], ["eval.py", "--help"], ["benchmark.py"]])
def test_a_reader_that_leaves_is_no_error(words):
    command = [sys.executable, str(SCRIPTS / words[0]), *words[1:]]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    complaint = process.stderr.read()
    assert (process.wait(), complaint) == (141, b"")
