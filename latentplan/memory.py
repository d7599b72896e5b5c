"""How much memory there is for a replay."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import torch

from latentplan.config import UserError

MEMORY_SHARE = 0.9
MEMORY_FACTS = Path("/proc/meminfo")


def check_memory(num_bytes: int, device: torch.device) -> None:
    """That a replay of so many bytes fits into nine tenths of what the device has free.

    Raises:
        UserError: It does not.
    """
    free = torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else free_memory()
    if num_bytes > MEMORY_SHARE * free:
        raise UserError(
            f"the replay takes {num_bytes / 2**30:.1f} GiB but {device.type} has {free / 2**30:.1f} GiB free: "
            "lower --replay.capacity or --frames"
        )


def free_memory() -> int:
    """Bytes of main memory that can be had; without /proc all there is, and no limit where even that is unknown."""
    if MEMORY_FACTS.exists():
        for line in MEMORY_FACTS.read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    if "SC_PHYS_PAGES" in getattr(os, "sysconf_names", {}):
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return sys.maxsize
