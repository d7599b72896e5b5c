"""Resources of a run: device, threads and the size of the replay."""

from __future__ import annotations

import os

import torch

from latentplan.config import Config, RunConfig, UserError

UNKNOWN_LENGTH_CAPACITY = 200_000
COLLECTOR_THREADS = 4  # an upper limit, because runs often share a machine


def choose_device(run: RunConfig) -> torch.device:
    """The device on which a run learns; "auto" takes CUDA if there is one.

    Raises:
        UserError: The settings ask for CUDA, but torch finds no CUDA device.
    """
    if run.device == "cuda" and not torch.cuda.is_available():
        raise UserError("device cuda was asked for, but torch finds no CUDA device: use --device cpu")
    if run.device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    return torch.device(run.device)


def choose_threads(overlap: bool) -> int:
    """CPU threads of each half of an update: of the world model, and of the behaviour, which learn at the same time.

    No two busy threads share a core. With `overlap` one core is left to the collection process.
    """
    return max(1, (_count_cores() - overlap) // 2)


def choose_collector_threads(device: torch.device) -> int:
    """CPU threads of the collection process: one if the learner uses the CPU, up to 4 if the learner uses a GPU."""
    return 1 if device.type == "cpu" else min(max(1, _count_cores() // 4), COLLECTOR_THREADS)


def set_up_torch(threads: int, device: torch.device) -> None:
    """Sets torch's number of CPU threads and, on a GPU, lets matrix products use tensor cores."""
    torch.set_num_threads(threads)
    if device.type == "cuda":
        torch.set_float32_matmul_precision("high")  # TF32, which has three more bits than bfloat16


def choose_replay_capacity(config: Config, saved: tuple[int, int]) -> int:
    """Rows of the replay: `replay.capacity`, or else enough for everything that the run collects.

    Args:
        config: Settings of the run.
        saved: Environments of the saved replay, and the largest number of rows that one of them holds. Without
            `replay.capacity` all saved rows fit.
    """
    if config.replay.capacity is not None:
        return config.replay.capacity
    num_saved = saved[0] * saved[1]
    if config.run.frames is None:
        return max(UNKNOWN_LENGTH_CAPACITY, num_saved)
    # Up to two rounds exceed the budget, and every episode ends with one frame without an action.
    decisions = config.run.frames / config.env.action_repeat
    per_episode = min(config.collection.episode_decisions or 20, 20)
    collected = 2 * config.collection.round_decisions + config.collection.prefill_decisions
    return max(int((1.0 + 1.0 / per_episode) * decisions) + collected, num_saved)


def _count_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
