"""What all learners share, beside their steps."""

import platform

import pytest

TOLD = """
import resource, sys, torch
from latentplan.training.optimization import keep_freed_memory

if "keep" in sys.argv:
    assert keep_freed_memory()
for round in range(60):
    if round == 10:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    blocks = [torch.ones(2_000_000) for _ in range(4)]
    del blocks
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="asks glibc")
def test_memory_that_is_freed_is_kept_for_what_comes_next(run_python):
    faults = {word: int(run_python("-c", TOLD, word).stdout) for word in ("keep", "")}
    assert faults["keep"] < faults[""] / 10, faults
