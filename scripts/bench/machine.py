"""The machine: its description, its peak FLOP/s, and a clock that waits for the device."""

from __future__ import annotations

import time
from typing import Any

import torch

from latentplan.config.origin import processor_name

PRODUCT_SIZES = {"cpu": 2048, "cuda": 8192}
SMALLEST_PRODUCT = 256
SLOW_SECONDS = 0.1
REPEATS = 4  # timed products, after one for warm-up
PRECISIONS = {"bfloat16": torch.bfloat16, "float32": torch.float32}


def describe_machine(device: torch.device) -> dict[str, Any]:
    """Processor, threads, device and versions, as plain values for JSON."""
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else processor_name()
    return {
        "device": device.type,
        "name": name,
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "float32_matmul_precision": torch.get_float32_matmul_precision(),
    }


def product_limits(device: torch.device, size: int | None = None) -> dict[str, float]:
    """Peak FLOP/s by precision: the fastest of a few large square matrix products.

    Args:
        device: Device that computes the products.
        size: Most rows and columns; None takes a size that fills the device.
    """
    largest = size or PRODUCT_SIZES[device.type]
    return {name: _product_limit(device, dtype, largest) for name, dtype in PRECISIONS.items()}


def _product_limit(device: torch.device, dtype: torch.dtype, largest: int) -> float:
    """Peak FLOP/s in one precision; a precision that the device emulates gets smaller products."""
    size = min(largest, SMALLEST_PRODUCT)
    while True:
        left = torch.randn(size, size, device=device, dtype=dtype)
        right = torch.randn(size, size, device=device, dtype=dtype)
        seconds = []
        for _ in range(1 + REPEATS):
            started = read_clock(device)
            torch.mm(left, right)
            seconds.append(read_clock(device) - started)
        if size == largest or min(seconds) > SLOW_SECONDS:
            return 2.0 * size**3 / min(seconds[1:])
        size = min(largest, 2 * size)


def read_clock(device: torch.device) -> float:
    """Waits until the device has finished all work, and returns the seconds of a monotonic clock."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()
