"""What a run takes of its machine: device, threads, replay."""

from __future__ import annotations

import os
from pathlib import Path

import torch

from latentplan.config import Config, RunConfig, UserError
from latentplan.replay.buffer import FRAME_BYTES

UNKNOWN_LENGTH_CAPACITY = 200_000
COLLECTOR_THREADS = 4  # at most: runs often share a machine


def choose_device(run: RunConfig) -> torch.device:
    """The device a run learns on.

    Raises:
        UserError: CUDA was asked for, and there is none.
    """
    if run.device == "cuda" and not torch.cuda.is_available():
        raise UserError("device cuda was asked for, but torch finds no CUDA device: use --device cpu")
    if run.device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    return torch.device(run.device)


def choose_threads(overlap: bool) -> int:
    """Threads of each half of an update.

    Model and behaviour each take this many, and one core is left to the process that collects, if there is one: threads
    that wait for each other on a shared core crawl.
    """
    return max(1, (_count_cores() - overlap) // 2)


def collector_threads(device: torch.device) -> int:
    """Threads of a process that collects beside a learner on a device: one where the learner wants the cores itself."""
    return 1 if device.type == "cpu" else min(max(1, _count_cores() // 4), COLLECTOR_THREADS)


def set_up_torch(threads: int, device: torch.device) -> None:
    """Have torch compute with so many threads and, on a GPU, on its tensor cores."""
    torch.set_num_threads(threads)
    if device.type == "cuda":
        torch.set_float32_matmul_precision("high")  # TF32, which has three more bits than bfloat16


def replay_capacity(config: Config, saved: Path) -> int:
    """Rows that hold everything a run collects, unless the settings say how many.

    Args:
        config: Settings of the run.
        saved: Where its replay is saved, if it is: what lies there stays, whatever the budget is now.
    """
    if config.replay.capacity is not None:
        return config.replay.capacity
    lanes = [path.stat().st_size // FRAME_BYTES for path in saved.glob("frames_*.u8")]
    held = len(lanes) * max(lanes, default=0)
    if config.run.frames is None:
        return max(UNKNOWN_LENGTH_CAPACITY, held)
    # Two rounds may run past the budget, and every episode ends with one frame without an action.
    decisions = config.run.frames / config.env.action_repeat
    per_episode = min(config.collection.episode_decisions or 20, 20)
    collected = 2 * config.collection.round_decisions + config.collection.prefill_decisions
    return max(int((1.0 + 1.0 / per_episode) * decisions) + collected, held)


def _count_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
