"""Memory that a replay takes, and memory that is free."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from latentplan.config.estimates import Part, check_parts

if TYPE_CHECKING:
    import torch

FRAME_BYTES = 64 * 64 * 3
MEMORY_FACTS = Path("/proc/meminfo")
LIMIT_FACTS = Path("/sys/fs/cgroup")


def count_replay_bytes(
    num_rows: int, action_dim: int, deter_dim: int, num_labels: int = 0, frame_bytes: int = FRAME_BYTES
) -> int:
    """Memory that a replay of `num_rows` rows takes, in bytes."""
    return num_rows * (frame_bytes + 2 * deter_dim + 4 * (action_dim + num_labels) + 4 + 4 + 8 + 1)


def describe_replay(num_bytes: int) -> Part:
    """A replay of a size as a part of what a run takes."""
    return Part("the replay", num_bytes, 0.0, "--replay.capacity or --frames")


def check_memory(num_bytes: int, device: torch.device) -> None:
    """Checks that a replay fits into nine tenths of the device's free memory.

    Args:
        num_bytes: Size of the replay.
        device: Device of the replay.

    Raises:
        UserError: The replay does not fit.
    """
    if device.type == "cuda":
        import torch

        free = torch.cuda.mem_get_info(device)[0]
    else:
        free = free_memory()
    check_parts([describe_replay(num_bytes)], free, device.type)


def free_memory() -> int:
    """Bytes of free main memory within the limit of a container; `sys.maxsize` if the system reports neither."""
    return min(_machine_memory(), _cgroup_memory())


def _machine_memory() -> int:
    """Bytes of available memory of the machine, or of its total memory on a system without /proc."""
    if MEMORY_FACTS.exists():
        for line in MEMORY_FACTS.read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    if "SC_PHYS_PAGES" in getattr(os, "sysconf_names", {}):
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return sys.maxsize


def _cgroup_memory() -> int:
    """Bytes that a container's control group (version 2) leaves; pages of files, which it can drop, count as free."""
    try:
        limit = (LIMIT_FACTS / "memory.max").read_text().strip()
        used = int((LIMIT_FACTS / "memory.current").read_text())
        pages = dict(line.split() for line in (LIMIT_FACTS / "memory.stat").read_text().splitlines())
    except OSError:
        return sys.maxsize  # the process is in no limited control group of version 2
    files = sum(int(pages.get(f"{kind}_file", 0)) for kind in ("inactive", "active"))
    return sys.maxsize if limit == "max" else max(0, int(limit) - used + files)
