"""What is there before a loop is no longer walked through by collections; what comes later is still collected.

Each law holds in a process of its own, because settling cannot be taken back.
"""

import subprocess
import sys

import pytest

SETTLED = """
import gc, sys, weakref
from latentplan.planning import settle

class Knot:
    def __init__(self):
        self.itself = self  # only a collection frees it

def locked_kilobytes():
    return int(next(line for line in open("/proc/self/status") if line.startswith("VmLck")).split()[1])

"""
LAWS = {
    "early garbage is collected first": """
reference = weakref.ref(Knot())
settle()
assert reference() is None
""",
    "what is there stays out": """
early = Knot()
reference = weakref.ref(early)
settle()
assert gc.get_freeze_count() > 10_000
del early
gc.collect()
assert reference() is not None
""",
    "later garbage is still collected": """
settle()
reference = weakref.ref(Knot())
gc.collect()
assert reference() is None
""",
    "memory is locked where that is allowed": """
allowed = settle()
assert sys.platform != "linux" or (locked_kilobytes() > 0) == allowed
""",
    "a refusal does no harm": """
import resource
resource.setrlimit(resource.RLIMIT_MEMLOCK, (0, 0))
allowed = settle()  # with the capability the limit does not count
assert sys.platform != "linux" or (locked_kilobytes() > 0) == allowed
assert gc.get_freeze_count() > 10_000
""",
}


@pytest.mark.parametrize("law", LAWS)
def test_after_settling(law):
    subprocess.run([sys.executable, "-c", SETTLED + LAWS[law]], check=True)
