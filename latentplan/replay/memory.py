"""How much memory there is for a replay."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from latentplan.config import UserError

if TYPE_CHECKING:
    import torch

MEMORY_SHARE = 0.9
MEMORY_FACTS = Path("/proc/meminfo")
LIMIT_FACTS = Path("/sys/fs/cgroup")


def check_memory(num_bytes: int, device: torch.device) -> None:
    """That a replay of so many bytes fits into nine tenths of what the device has free.

    Raises:
        UserError: It does not.
    """
    if device.type == "cuda":
        import torch

        free = torch.cuda.mem_get_info(device)[0]
    else:
        free = free_memory()
    if num_bytes > MEMORY_SHARE * free:
        raise UserError(
            f"the replay takes {num_bytes / 2**30:.1f} GiB but {device.type} has {free / 2**30:.1f} GiB free: "
            "lower --replay.capacity or --frames"
        )


def free_memory() -> int:
    """Bytes of main memory that can be had, within a container's limit; `sys.maxsize` where nothing is known."""
    return min(_machine_memory(), _left_of_limit())


def _machine_memory() -> int:
    """What the machine has available; without /proc all that it has."""
    if MEMORY_FACTS.exists():
        for line in MEMORY_FACTS.read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    if "SC_PHYS_PAGES" in getattr(os, "sysconf_names", {}):
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return sys.maxsize


def _left_of_limit() -> int:
    """What the control group (version 2) of a container leaves, counting file pages that can be dropped as free."""
    try:
        limit = (LIMIT_FACTS / "memory.max").read_text().strip()
        used = int((LIMIT_FACTS / "memory.current").read_text())
        pages = dict(line.split() for line in (LIMIT_FACTS / "memory.stat").read_text().splitlines())
    except OSError:
        return sys.maxsize  # no such limit
    return sys.maxsize if limit == "max" else max(0, int(limit) - used + int(pages.get("inactive_file", 0)))
