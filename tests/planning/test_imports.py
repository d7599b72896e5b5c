"""The planning package imports torch and einops, and no simulator or trainer."""

import subprocess
import sys
from pathlib import Path

PROJECT = Path(__file__).parents[2]
BLOCKED = ("dm_control", "mujoco", "cv2", "gymnasium", "lightning")
SCRIPT = f"""
import sys
for name in {BLOCKED}:
    sys.modules[name] = None  # importing it now raises ImportError
import torch
before = set(sys.modules)
import latentplan.planning
ours = {{name.split(".")[0] for name in set(sys.modules) - before}}
foreign = ours - set(sys.stdlib_module_names) - {{"torch", "numpy", "einops", "latentplan"}}
assert not foreign, foreign
project = {{name for name in sys.modules if name.startswith("latentplan.")}}
strays = {{name for name in project if not name.startswith(("latentplan.planning", "latentplan.config"))}}
assert not strays, strays
"""


def test_planning_imports_only_torch_einops_and_config():
    subprocess.run([sys.executable, "-c", SCRIPT], cwd=PROJECT, check=True)
