"""`benchmark.py train`: time of an update of the learner, part by part, on synthetic replay.

The table shows milliseconds, GFLOP and GFLOP/s of each part, beside the GFLOP/s of a large matrix product.
"""

from __future__ import annotations

from typing import Any

from bench.options import (
    COMPOSE_FLAGS,
    DEVICE_FLAGS,
    Flags,
    action_size,
    choose_device,
    composed_config,
    output_path,
    whole_number,
)
from bench.report import format_table, number, write_json

FLAGS = {
    **COMPOSE_FLAGS,
    "--updates": ("N", "updates that are timed (20)"),
    **DEVICE_FLAGS,
    "--json": ("FILE", "result as JSON"),
}
SETTINGS = ("model", "learning", "replay")


def run(flags: Flags) -> int:
    """Time updates on synthetic replay and print where the time goes."""
    updates, json_path = whole_number(flags, "--updates", 20), output_path(flags, "--json")
    config = composed_config(flags)
    device = choose_device(flags)
    action_dim = action_size(flags, config)
    import torch

    from bench.machine import describe_machine, product_limits
    from bench.train_update import measure_update
    from latentplan.training.resources import set_up_torch

    set_up_torch(torch.get_num_threads(), device)  # as a run does
    before = product_limits(device)
    measured = measure_update(config, action_dim, device, updates)
    after = product_limits(device)  # the better of two: other work may have disturbed one
    limits = {name: max(before[name], after[name]) for name in before}
    result = {
        "domain": config.env.domain,
        "machine": describe_machine(device),
        **measured,
        "limit_flop_per_s": limits,
        "fraction_of_limit": {name: measured["flop_per_s"] / limit for name, limit in limits.items()},
    }
    print(_summary(result))
    write_json(json_path, result)
    return 0


def _summary(result: dict[str, Any]) -> str:
    total_ms, machine = result["in_turn_ms"], result["machine"]
    rows = [
        [
            name,
            number(part["ms"], 2),
            number(100.0 * part["ms"] / total_ms),
            number(part["flop"] / 1e9, 2),
            number(part["flop"] / part["ms"] / 1e6) if part["flop"] and part["ms"] > 0 else "-",
        ]
        for name, part in {**result["parts"], "in turn": {"ms": total_ms, "flop": result["flop"]}}.items()
    ]
    limits = "; ".join(
        f"{name} {limit / 1e9:,.0f} GFLOP/s, of which {100.0 * result['fraction_of_limit'][name]:.1f} % are reached"
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
