"""`settle` excludes present objects from garbage collection and locks memory; later objects are still collected.

Each test runs in a process of its own, because `settle` cannot be undone.
"""

import subprocess
import sys

PROLOGUE = """
import gc, sys, weakref
from latentplan.planning import settle

class Knot:
    def __init__(self):
        self.itself = self  # only a collection frees it

def locked_kilobytes():
    return int(next(line for line in open("/proc/self/status") if line.startswith("VmLck")).split()[1])

"""


def run(program):
    subprocess.run([sys.executable, "-c", PROLOGUE + program], check=True)


def test_settle_collects_once_and_excludes_only_present_objects_and_locks_memory_where_allowed():
    run("""
garbage, present = weakref.ref(Knot()), Knot()
reference = weakref.ref(present)
allowed = settle()
assert garbage() is None
assert gc.get_freeze_count() > 10_000
del present
later = weakref.ref(Knot())
gc.collect()
assert reference() is not None and later() is None
assert sys.platform != "linux" or (locked_kilobytes() > 0) == allowed
""")


def test_settle_freezes_objects_when_memory_may_not_be_locked():
    run("""
import resource
resource.setrlimit(resource.RLIMIT_MEMLOCK, (0, 0))
allowed = settle()  # with the capability to lock memory the limit does not count
assert sys.platform != "linux" or (locked_kilobytes() > 0) == allowed
assert gc.get_freeze_count() > 10_000
""")
