"""`benchmark.py train`: time of an update of the learner, part by part, on synthetic replay.

The table shows milliseconds, GFLOP and GFLOP/s of each part, beside the GFLOP/s of a large matrix product on as many
threads. Side by side, model and behaviour have as many threads each. With `--against REV` another commit is timed in
turns with this tree, so that a speed-up is a ratio of one sitting.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.options import ComposeRequest
from bench.report import format_number, format_table, write_json
from latentplan.commands.flags import overrides
from latentplan.config import LearningConfig, ModelConfig, ReplayConfig
from latentplan.config.checks import at_least
from latentplan.config.parsing import option


@dataclass(frozen=True, kw_only=True)
class Request(ComposeRequest):
    """Flags of `benchmark.py train`.

    Attributes:
        updates: Timed updates.
        json: Result as JSON.
        against: Commit to compare with: both trees are timed in turns, and the ratio of updates per second is printed.
        model: Settings of the model.
        learning: Settings of the learning.
        replay: Settings of the replay.
    """

    updates: int = 20
    json: Path | None = option(None, metavar="FILE", is_output=True)
    against: str | None = option(None, metavar="REV")
    model: dict[str, Any] = overrides(ModelConfig, prefix="model.")
    learning: dict[str, Any] = overrides(LearningConfig, prefix="learning.")
    replay: dict[str, Any] = overrides(ReplayConfig, prefix="replay.")

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, updates=1)


def run(request: Request) -> int:
    """Times updates on synthetic replay and prints the time of each part."""
    from bench.against import compare_with, find_commit

    commit = None if request.against is None else find_commit(request.against)
    config = request.compose({"model": request.model, "learning": request.learning, "replay": request.replay})
    device_name = request.use_device()
    action_dim = request.action_size(config)
    import torch

    device = torch.device(device_name)
    from bench.machine import describe_machine, product_limits
    from bench.train_update import measure_update
    from latentplan.training.resources import set_up_torch

    set_up_torch(torch.get_num_threads(), device)  # as in a run
    before = product_limits(device)
    measured = measure_update(config, action_dim, device, request.updates)
    after = product_limits(device)  # the better of two measurements, because other work may disturb one
    limits = {name: max(before[name], after[name]) for name in before}
    result = {
        "domain": config.env.domain,
        "machine": describe_machine(device),
        **measured,
        "limit_flop_per_s": limits,
        "fraction_of_limit": shares_of_limits(measured, limits),
    }
    print(_summary(result))
    if commit is not None:
        result["compare"] = compared = compare_with(commit, "train", _repeat_flags(request), "updates_per_s")
        print(f"{compared['ratio']:.3f} times the updates/s of {compared['commit'][:12]} (medians, in turns)")
    write_json(request.json, result)
    return 0


def shares_of_limits(measured: Mapping[str, Any], limits: Mapping[str, float]) -> dict[str, float]:
    """Shares of the limits that an update reaches with its halves in turn, on the threads of the product.

    Side by side each half has these threads to itself, so that the limits are no limits of both.

    Args:
        measured: Result of `measure_update`.
        limits: Result of `product_limits`.
    """
    flop_per_s = 1000.0 * measured["flop"] / measured["in_turn_ms"]
    return {name: flop_per_s / limit for name, limit in limits.items()}


def _repeat_flags(request: Request) -> list[str]:
    """The flags that time the same updates again."""
    single = ("domain", "preset", "action_dim", "updates", "device", "threads")
    given = {f"--{name.replace('_', '-')}": getattr(request, name) for name in single}
    for section in ("model", "learning", "replay"):
        given |= {f"--{section}.{name}": value for name, value in getattr(request, section).items()}
    return [
        f"{flag}={json.dumps(value) if isinstance(value, tuple | bool) else value}"
        for flag, value in given.items()
        if value is not None
    ]


def _summary(result: dict[str, Any]) -> str:
    total_ms, machine = result["in_turn_ms"], result["machine"]
    rows = [
        [
            name,
            format_number(part["ms"], 2),
            format_number(100.0 * part["ms"] / total_ms),
            format_number(part["flop"] / 1e9, 2),
            format_number(part["flop"] / part["ms"] / 1e6) if part["flop"] and part["ms"] > 0 else "-",
        ]
        for name, part in {**result["parts"], "in turn": {"ms": total_ms, "flop": result["flop"]}}.items()
    ]
    limits = "; ".join(
        f"{name} {limit / 1e9:,.0f} GFLOP/s, in turn {100.0 * result['fraction_of_limit'][name]:.1f} % are reached"
        for name, limit in result["limit_flop_per_s"].items()
    )
    return "\n".join(
        [
            f"{result['domain']} on {machine['name']} ({machine['device']}, {machine['threads']} threads), "
            f"{result['parameters']:,} parameters, batch {result['batch_size']} x {result['sequence_length']}",
            format_table(["part", "ms", "%", "GFLOP", "GFLOP/s"], rows),
            f"{result['update_ms']:.1f} ms with model and behaviour side by side: "
            f"{result['updates_per_s']:.2f} updates/s, {result['frames_per_s']:,.0f} frames replayed/s "
            f"(medians of {result['updates']} updates)",
            *([] if result["graph_ms"] is None else [f"{result['graph_ms']:.2f} ms as one CUDA graph"]),
            f"a big product: {limits}",
        ]
    )
