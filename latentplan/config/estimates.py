"""Estimates of memory and time, by which settings that this machine cannot serve are refused before any work begins.

The estimates count the largest tensors and the matrix products, in the fastest way that they could be computed. They
are therefore lower bounds: what they refuse is impossible, and what they let pass may still be slow.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from latentplan.config.checks import UserError
from latentplan.config.planner import SearchOptions
from latentplan.config.settings import ModelConfig

FLOATS_PER_S = 2e11  # operations of one fast core in a second
DEVICE_FLOATS_PER_S = 2e15  # operations of a graphics processor in a second
STEP_S = 1e-6  # one step of a rollout of any size
LONGEST_DECISION_S = 60.0
CONTROL_GROUP = Path("/sys/fs/cgroup")
MEMORY_SHARE = 0.9
_FLOAT = 4  # bytes


@dataclass(frozen=True)
class Part:
    """A part of the program and what it takes.

    Attributes:
        name: The part, for messages.
        num_bytes: Memory.
        seconds: Time per decision.
        advice: The settings that make the part smaller.
    """

    name: str
    num_bytes: float
    seconds: float
    advice: str


def count_parameters(model: ModelConfig, action_dim: int = 1, frame_size: int = 64) -> int:
    """The number of weights of a world model for one camera, without biases and the scales of norms."""
    features, hidden, deter = model.deter_dim + model.latent_dim, model.hidden_dim, model.deter_dim
    channels = model.encoder_channels
    side = frame_size // 4 // 2 ** (len(channels) - 1)
    encoder = 48 * channels[0] + sum(16 * before * after for before, after in pairwise(channels))
    encoder += channels[-1] * side * side * hidden
    dynamics = (model.latent_dim + action_dim) * hidden + (hidden + deter) * 3 * deter + 2 * deter * hidden
    dynamics += 4 * hidden * model.latent_dim
    widths = [features, *[model.decoder_width] * model.decoder_layers]
    tokens = features + sum(widths[1:][-1:])
    decoder = sum(before * after for before, after in pairwise(widths))
    decoder += tokens * model.decoder_channels * 64 + 36 * model.decoder_channels**2
    trunk = features * hidden + hidden * hidden
    heads = 4 * trunk + 2 * hidden * model.num_bins + 2 * hidden * action_dim
    return encoder + dynamics + decoder + heads


def estimate_search(search: SearchOptions, model: ModelConfig, on_device: bool = False) -> Part:
    """Memory and time of one search in a world model, for actions of one number.

    Args:
        search: Options of the search.
        model: Sizes of the model.
        on_device: Whether a graphics processor may search.
    """
    rows = search.num_samples * model.turns
    horizon = max(search.horizon, search.goal_horizon or 0)
    state = model.deter_dim + model.latent_dim
    candidates = search.num_samples * horizon * 3  # noise, actions and the sorted copy
    num_bytes = _FLOAT * (candidates + rows * (2 * state + 3 * model.deter_dim + 2 * model.hidden_dim) + rows * horizon)
    hidden, deter = model.hidden_dim, model.deter_dim
    products = (hidden + deter) * 3 * deter + 2 * deter * hidden + state * hidden + hidden * hidden
    iterations = 1 if search.deadline_ms is not None else max(search.num_iterations, search.num_warm_iterations)
    steps = iterations * horizon
    gradient = search.gradient_steps * horizon if search.deadline_ms is None else 0
    speed = DEVICE_FLOATS_PER_S if on_device else FLOATS_PER_S * count_cores()
    seconds = 2 * products * (steps * rows + 3 * gradient) / speed + STEP_S * (steps + 3 * gradient)
    advice = "--planner.num_samples, --planner.horizon, --planner.num_iterations or --planner.gradient_steps"
    return Part("a search", num_bytes, seconds, advice)


def estimate_model(model: ModelConfig, copies: int = 1, frame_size: int = 64) -> Part:
    """Memory of a world model and its copies."""
    sizes = "--model.deter_dim, --model.hidden_dim, --model.num_bins, --model.encoder_channels or the decoder's"
    return Part("the model", _FLOAT * copies * count_parameters(model, frame_size=frame_size), 0.0, sizes)


def check_parts(parts: list[Part], free: float, place: str = "main memory") -> None:
    """Refuses parts that do not fit into the memory, alone or together, or that make a decision take minutes.

    Args:
        parts: The parts.
        free: Free bytes.
        place: The memory, for the message.

    Raises:
        UserError: The parts take too much; the message names the largest part and the settings that make it smaller.
    """
    needed = sum(part.num_bytes for part in parts)
    if needed > MEMORY_SHARE * free:
        part = max(parts, key=lambda part: part.num_bytes)
        raise UserError(
            f"{part.name} takes about {_gib(part.num_bytes)} GiB, of {_gib(needed)} GiB in all, but {place} has "
            f"{_gib(free)} GiB free: lower {part.advice}"
        )
    seconds = sum(part.seconds for part in parts)
    if seconds > LONGEST_DECISION_S:
        part = max(parts, key=lambda part: part.seconds)
        raise UserError(
            f"{part.name} takes at least {part.seconds:,.4g} s per decision on this machine, and at most "
            f"{LONGEST_DECISION_S:g} s are allowed: lower {part.advice}"
        )


def count_cores() -> int:
    """Processor cores that this process may use, within the quota of a container (control groups 1 and 2)."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, _read_quota() or cores)


def choose_threads(collectors: int, processes: int = 1) -> int:
    """CPU threads of each half of an update: of the world model, and of the behaviour, which learn at the same time.

    No two busy threads share a core, as far as the cores suffice for as many learning processes. One core is left to
    each of the `collectors`, the collection processes of a learning process.
    """
    return max(1, (count_cores() // processes - collectors) // 2)


def _read_quota() -> int | None:
    """Cores that a container's quota allows, rounded up; None without a quota."""
    try:
        if (path := CONTROL_GROUP / "cpu.max").exists():
            quota, period = path.read_text().split()
        else:
            quota, period = ((CONTROL_GROUP / "cpu" / f"cpu.cfs_{name}_us").read_text() for name in ("quota", "period"))
        return max(1, math.ceil(int(quota) / int(period))) if quota.strip() not in ("max", "-1") else None
    except (OSError, ValueError, ZeroDivisionError):
        return None


def _gib(num_bytes: float) -> str:
    return f"{num_bytes / 2**30:.1f}" if num_bytes < 2**50 else f"{num_bytes / 2**30:.1e}"
