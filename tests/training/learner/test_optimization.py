"""What all learners share, beside their steps."""

import json
import platform

import pytest

BLOCK = 30_000_000

# Asked of malloc itself: what the system does with memory that is handed back differs between machines.
# Thresholds that are set explicitly keep glibc from moving them by itself, see mallopt(3).
TOLD = f"""
import ctypes, json, torch
from latentplan.training.learner.optimization import keep_freed_memory

class Mallinfo(ctypes.Structure):  # mallinfo(3)
    _fields_ = [(name, ctypes.c_uint) for name in (
        "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keepcost").split()]

libc = ctypes.CDLL(None)
libc.mallinfo.restype = Mallinfo

def mapped_and_kept():
    before = libc.mallinfo()
    block = torch.ones({BLOCK} // 4)
    during = libc.mallinfo()
    del block
    return during.hblkhd - before.hblkhd, libc.mallinfo().fordblks

for name in (-1, -3):  # the thresholds of trimming and of mapping, as malloc begins with them
    assert libc.mallopt(name, 128 * 1024)
as_begun = mapped_and_kept()
assert keep_freed_memory()
print(json.dumps([as_begun, mapped_and_kept()]))
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="asks glibc")
def test_memory_that_is_freed_is_kept_for_what_comes_next(run_python):
    (mapped_before, _), (mapped, kept) = json.loads(run_python("-c", TOLD).stdout)
    assert mapped_before >= BLOCK, "an allocation of this size is mapped anew and handed back"
    assert mapped == 0, "it comes from the heap"
    assert kept >= BLOCK, "and stays there"
