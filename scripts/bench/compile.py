"""`benchmark.py compile`: searches in small models, stepped in Python or compiled by `compile_rollout`.

The table shows median milliseconds per search of both versions, the ratio of the two medians, the seconds of
compilation, and the largest difference between the planned actions.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

from bench.options import SearchRequest
from bench.report import format_number, format_table, write_json
from latentplan.config.checks import at_least
from latentplan.config.parsing import option

if TYPE_CHECKING:
    import torch

    from latentplan.planning import CEMPlanner, Model

WARM_UP_PLANS = 3  # torch.compile compiles at the first size, and again, for any size, at the second


@dataclass(frozen=True, kw_only=True)
class Request(SearchRequest):
    """Flags of `benchmark.py compile`.

    Attributes:
        plans: Timed searches of each version of each model.
        json: Result as JSON.
    """

    plans: int = 30
    json: Path | None = option(None, metavar="FILE", is_output=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, plans=1)


def run(request: Request) -> int:
    """Times searches in both versions of each model, in turns, and prints the comparison."""
    plans, sizes = request.plans, request.sizes
    device_name = request.use_device()
    import torch

    from bench.machine import describe_machine
    from latentplan.planning import CEMPlanner

    device = torch.device(device_name)
    planner = CEMPlanner(
        action_dim=1,
        horizon=sizes["horizon"],
        num_samples=sizes["samples"],
        num_elites=max(1, sizes["samples"] // 10),
        num_iterations=sizes["iterations"],
    )
    rows = [
        {"model": name, **measure_model(model, state.to(device), planner, plans)}
        for name, (model, state) in own_models(device).items()
    ]
    machine = describe_machine(device)
    extent = f"{sizes['samples']:,} samples x {sizes['horizon']} steps x {sizes['iterations']} iterations"
    print(f"{machine['name']} ({device.type}, {machine['threads']} threads), {extent}")
    header = ["model", "stepped, ms p50", "compiled", "ratio", "compilation, s", "actions differ by"]
    keys = (("stepped_ms", 1), ("compiled_ms", 1), ("ratio", 2), ("compilation_s", 1), ("largest_difference", 7))
    lines = [[row["model"], *(format_number(row[key], digits) for key, digits in keys)] for row in rows]
    print(format_table(header, lines))
    write_json(request.json, {**sizes, "plans": plans, "machine": machine, "rows": rows})
    return 0


def own_models(device: torch.device) -> dict[str, tuple[Model, torch.Tensor]]:
    """A model made of equations and a model that is a small network, each with a start state (1, n)."""
    import torch

    from latentplan.planning import FunctionModel

    def swing(state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        angle, speed = state.unbind(dim=1)
        speed = (speed + 0.05 * (15.0 * torch.sin(angle) + 6.0 * action[:, 0])).clamp(-8.0, 8.0)
        return torch.stack([angle + 0.05 * speed, speed], dim=1)

    def upright(state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        angle, speed = torch.remainder(state[:, 0] + torch.pi, 2 * torch.pi) - torch.pi, state[:, 1]
        return -(angle.square() + 0.1 * speed.square() + 0.004 * action[:, 0].square())

    torch.manual_seed(0)
    layers = [torch.nn.Linear(5, 128), torch.nn.SiLU(), torch.nn.Linear(128, 128), torch.nn.SiLU()]
    network = torch.nn.Sequential(*layers, torch.nn.Linear(128, 4)).to(device)
    return {
        "pendulum's equations": (FunctionModel(swing, upright), torch.tensor([[3.0, 0.0]])),
        "network of 2 x 128": (
            FunctionModel(
                lambda state, action: state + network(torch.cat([state, action], dim=1)),
                lambda state, action: -state.square().sum(dim=1),
            ),
            torch.ones(1, 4),
        ),
    }


def measure_model(model: Model, state: torch.Tensor, planner: CEMPlanner, plans: int) -> dict[str, Any]:
    """Median milliseconds of a search in the model, stepped and compiled, from the same noise.

    Returns:
        `stepped_ms`, `compiled_ms`, their `ratio`, `compilation_s` (extra seconds of the first compiled searches) and
        `largest_difference` between the planned action sequences of both versions.
    """
    import torch

    from bench.machine import read_clock
    from latentplan.planning import compile_rollout

    def search(arm: Model, seed: int) -> tuple[float, torch.Tensor]:
        generator = torch.Generator(state.device).manual_seed(seed)
        started = read_clock(state.device)
        actions = planner.plan(arm, state, generator=generator).actions
        return read_clock(state.device) - started, actions

    arms = (model, compile_rollout(model))
    first = [sum(search(arm, seed)[0] for seed in range(WARM_UP_PLANS)) for arm in arms]
    laps = [[search(arm, seed) for arm in arms] for seed in range(plans)]
    stepped, compiled = (median(lap[index][0] for lap in laps) for index in range(2))
    return {
        "stepped_ms": 1000.0 * stepped,
        "compiled_ms": 1000.0 * compiled,
        "ratio": stepped / compiled,
        "compilation_s": first[1] - WARM_UP_PLANS * compiled,
        "largest_difference": max(float((lap[0][1] - lap[1][1]).abs().max()) for lap in laps),
    }
