"""Optimizer steps and memory settings that all learners share."""

import json
import platform

import pytest

BLOCK = 30_000_000

# The script reads malloc's own counters, because systems differ in what they do with returned memory. It sets both
# thresholds first, which keeps glibc from adapting them (mallopt(3)), and loads the module without its package.
SCRIPT = f"""
import ctypes, importlib.util, json, torch

spec = importlib.util.spec_from_file_location("optimization", "latentplan/training/learner/optimization.py")
optimization = importlib.util.module_from_spec(spec)
spec.loader.exec_module(optimization)

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

for name in (-1, -3):  # malloc's initial thresholds of trimming and of mapping
    assert libc.mallopt(name, 128 * 1024)
before = mapped_and_kept()
assert optimization.keep_freed_memory()
print(json.dumps([before, mapped_and_kept()]))
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="asks glibc")
def test_keep_freed_memory_serves_large_tensors_from_the_heap(run_python):
    (mapped_before, _), (mapped, kept) = json.loads(run_python("-c", SCRIPT).stdout)
    assert mapped_before >= BLOCK, "an allocation of this size is mapped anew and handed back"
    assert mapped == 0, "it comes from the heap"
    assert kept >= BLOCK, "and stays there"


RETURN_SCRIPT = """
import importlib.util, pathlib, torch

spec = importlib.util.spec_from_file_location("optimization", "latentplan/training/learner/optimization.py")
optimization = importlib.util.module_from_spec(spec)
spec.loader.exec_module(optimization)

def resident_kib():
    lines = pathlib.Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS"))

assert optimization.keep_freed_memory()
blocks = [torch.ones(50_000) for _ in range(500)]  # 95 MiB
last = torch.ones(1_000)  # lies behind the blocks, so that the end of the heap cannot shrink
held = resident_kib()
del blocks
kept = resident_kib()
assert optimization.return_freed_memory()
print(held - kept, kept - resident_kib())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="asks glibc")
def test_freed_memory_stays_until_it_is_returned(run_python):
    returned_by_itself, returned = map(int, run_python("-c", RETURN_SCRIPT).stdout.split())
    assert returned_by_itself < 10_000
    assert returned > 80_000
