"""Where results come from: the machine, the commit of a checkout, and the versions of libraries."""

from __future__ import annotations

import importlib.metadata
import platform
import subprocess
from pathlib import Path
from typing import Any

from latentplan import __version__
from latentplan.config.estimates import count_cores

ROOT = Path(__file__).resolve().parents[2]
GPU_FACTS = Path("/proc/driver/nvidia/gpus")
UNKNOWN = "unknown"
LIBRARIES = ("torch", "numpy", "mujoco", "dm-control", "gymnasium", "lightning", "opencv-python-headless")


def processor_name() -> str:
    """Model name of the processor."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass  # only Linux has this file
    return platform.processor() or platform.machine()


def describe_hardware(on_gpu: bool) -> str:
    """Cores, processor and, where results are computed on a GPU, the model of the GPU."""
    return ", ".join([f"{count_cores()} cores of {processor_name()}", *(_gpu_names() if on_gpu else ())])


def describe_commit() -> str:
    """The short name of the commit of this checkout, with `-dirty` after it where files differ from the commit."""
    if not (ROOT / ".git").exists():  # an installed package inside the checkout of another project
        return UNKNOWN
    command = ["git", "-C", str(ROOT), "describe", "--always", "--dirty", "--abbrev=8", "--exclude", "*"]
    try:
        found = subprocess.run(command, capture_output=True, text=True)
    except OSError:  # no git
        return UNKNOWN
    return found.stdout.strip() or UNKNOWN


def present_facts(on_gpu: bool) -> dict[str, Any]:
    """Commit, version, hardware and libraries of this process, as plain values for JSON."""
    facts = {"commit": describe_commit(), "version": __version__, "hardware": describe_hardware(on_gpu)}
    return {**facts, "libraries": library_versions()}


def library_versions() -> dict[str, str]:
    """Versions of Python and of the libraries that shape results, by name; without those that are not installed."""
    versions = {"python": platform.python_version()}
    for name in LIBRARIES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return versions


def _gpu_names() -> list[str]:
    names = []
    for facts in sorted(GPU_FACTS.glob("*/information")):
        lines = facts.read_text().splitlines()
        names += [line.partition(":")[2].strip() for line in lines if line.startswith("Model")]
    return names[:1]
