"""`benchmark.py plan`: the project's planner beside planners of other libraries, on one model with one setting.

The table shows milliseconds per search as percentiles, and ratios to the project's planner and to the matrix products
alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from bench.options import ComposeRequest, SearchRequest
from bench.peers.install import FOLDER, PEERS, choose_peers, left_out_on_error
from bench.report import format_number, format_table, write_json
from latentplan.commands.flags import overrides
from latentplan.config import ModelConfig, to_dict
from latentplan.config.checks import at_least
from latentplan.config.parsing import option

if TYPE_CHECKING:
    from bench.peers.client import PeerProcess
    from bench.peers.problem import Problem

WARM_UP_PLANS = 2
OURS, PLAIN, PRODUCTS = "latentplan", "plain loop", "matrix products"
Times = dict[tuple[str, str], list[float]]


class Arm(NamedTuple):
    """A planner that is timed.

    Attributes:
        planner: Name of the planner.
        dtype: Precision of the model's trunk.
        search_ms: Runs one search and returns its milliseconds.
    """

    planner: str
    dtype: str
    search_ms: Callable[[], float]


class Comparison(NamedTuple):
    """Times of all planners.

    Attributes:
        times: Milliseconds of each search, by planner and dtype.
        versions: Version of each other library that took part.
        left_out: Reason for each library that did not take part.
    """

    times: Times
    versions: dict[str, str]
    left_out: dict[str, str]


@dataclass(frozen=True, kw_only=True)
class Request(SearchRequest, ComposeRequest):
    """Flags of `benchmark.py plan`.

    Attributes:
        peers: Other planners, or `none`; each is installed on first use, in a Python environment apart from this one.
        plans: Timed searches of each planner, taken in turns.
        json: Result as JSON.
        scaling: Picture of the time of this planner against samples, horizon, iterations and environments.
        model: Settings of the model.
    """

    peers: tuple[str, ...] = option(tuple(PEERS), separator=",")
    plans: int = 30
    json: Path | None = option(None, metavar="FILE", is_output=True)
    scaling: Path | None = option(None, metavar="PNG", is_output=True)
    model: dict[str, Any] = overrides(ModelConfig, prefix="model.")

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, plans=1)
        choose_peers(self.peers)


def run(request: Request) -> int:
    """Times every planner in turns and prints the comparison."""
    plans, sizes = request.plans, request.sizes
    config = request.compose({"model": request.model})
    device_name = request.use_device()
    import torch

    from bench.machine import describe_machine
    from bench.peers.problem import Problem

    device = torch.device(device_name)
    problem = Problem(
        **sizes,
        action_dim=request.action_size(config),
        model=to_dict(config.model),
        device=device.type,
        threads=torch.get_num_threads(),
    )
    machine = describe_machine(device)
    measured = compare(problem, choose_peers(request.peers), plans)
    result = {
        **summarise(measured.times, problem.threads),
        "peers": measured.versions,
        "left_out": measured.left_out,
        "settings": {**sizes, "elites": problem.num_elites, "action_dim": problem.action_dim, "plans": plans},
        "model": problem.model,
        "machine": machine,
    }
    print(f"{machine['name']} ({device.type}, {machine['threads']} threads), {config.env.domain}, {sizes}")
    print(comparison_table(result))
    if request.scaling is not None:
        from bench.plan_scaling import measure_scaling, plot_scaling, scaling_table

        result["scaling"] = measure_scaling(problem, result["best_dtype"])
        print(scaling_table(result["scaling"]))
        plot_scaling(result["scaling"], request.scaling)
    write_json(request.json, result)
    return 0


def compare(problem: Problem, peers: Sequence[str], plans: int, folder: Path = FOLDER) -> Comparison:
    """Times every planner.

    Args:
        problem: The search.
        peers: Names of `PEERS`.
        plans: Timed searches of each planner. The planners take turns, so that a busy machine slows down all of them.
        folder: Folder of the peers' Python environment, which is made on first use.
    """
    from bench.peers.client import PeerProcess
    from bench.peers.problem import DTYPES

    left_out: dict[str, str] = {}
    processes: list[PeerProcess] = []
    try:
        for name in peers:
            with left_out_on_error(name, left_out):
                processes.append(PeerProcess(name, problem, folder))
        peer_arms = [_peer_arm(process, dtype) for process in processes for dtype in DTYPES]
        times = _take_turns([*own_arms(problem), *peer_arms], plans, left_out)
    finally:
        for process in processes:
            process.close()
    versions = {process.name: process.version for process in processes if process.name not in left_out}
    return Comparison(times, versions, left_out)


def own_arms(problem: Problem) -> list[Arm]:
    """This project's planner, a plain loop, and the matrix products alone."""
    from bench.peers.problem import DTYPES
    from bench.plan_searches import matrix_products, plain_search, planner_search, timed

    return [
        *(Arm(OURS, dtype, timed(planner_search(problem, dtype), problem)) for dtype in DTYPES),
        Arm(PLAIN, "float32", timed(plain_search(problem), problem)),
        *(Arm(PRODUCTS, dtype, timed(matrix_products(problem, dtype), problem)) for dtype in DTYPES),
    ]


def summarise(times: Times, threads: int) -> dict[str, Any]:
    """Percentiles of every planner and ratios between planners; a ratio to other libraries is None without a library.

    Args:
        times: Milliseconds of each search by planner and dtype, including `OURS` and `PRODUCTS`.
        threads: CPU threads of every planner.
    """
    import numpy as np

    from latentplan.evaluation.statistics import latency_percentiles

    facts = {key: latency_percentiles(np.asarray(laps)) for key, laps in times.items()}
    p50 = {key: percentiles["p50"] for key, percentiles in facts.items()}
    best = min((dtype for planner, dtype in p50 if planner == OURS), key=lambda dtype: p50[OURS, dtype])
    rivals = {key: value for key, value in p50.items() if key[0] not in (OURS, PLAIN, PRODUCTS)}
    shipped = [value for (_, dtype), value in rivals.items() if dtype == "float32"]
    equal = [value for (_, dtype), value in rivals.items() if dtype == best]
    rows = [
        {"planner": planner, "dtype": dtype, "threads": threads, **{f"{p}_ms": ms for p, ms in percentiles.items()}}
        for (planner, dtype), percentiles in facts.items()
        if planner != PRODUCTS
    ]
    return {
        "ratio_fastest_peer": min(shipped) / p50[OURS, best] if shipped else None,
        "ratio_fastest_peer_same_dtype": min(equal) / p50[OURS, best] if equal else None,
        "ratio_matrix_limit": p50[OURS, best] / p50[PRODUCTS, best],
        "best_dtype": best,
        "matrix_limit_ms": {dtype: value for (planner, dtype), value in p50.items() if planner == PRODUCTS},
        "rows": rows,
    }


def comparison_table(result: dict[str, Any]) -> str:
    """The comparison as a text table."""
    best, limits = result["best_dtype"], result["matrix_limit_ms"]
    ours = next(row["p50_ms"] for row in result["rows"] if row["planner"] == OURS and row["dtype"] == best)
    lines = [
        [row["planner"], row["dtype"], *(format_number(row[f"{p}_ms"]) for p in ("p50", "p95", "p99"))]
        + [format_number(row["p50_ms"] / ours, 2), format_number(row["p50_ms"] / limits[row["dtype"]], 2)]
        for row in result["rows"]
    ]
    lines += [
        [PRODUCTS, dtype, format_number(ms), "-", "-", format_number(ms / ours, 2), "1.00"]
        for dtype, ms in limits.items()
    ]
    header = ["planner", "dtype", "p50 ms", "p95", "p99", "x ours", "x products"]
    return "\n".join(
        [
            format_table(header, lines),
            f"{result['settings']['plans']} searches each; fastest peer / ours: "
            f"{format_number(result['ratio_fastest_peer'], 2)} as shipped, "
            f"{format_number(result['ratio_fastest_peer_same_dtype'], 2)} in {best}; "
            f"ours / its matrix products: {format_number(result['ratio_matrix_limit'], 2)}",
        ]
    )


def _peer_arm(process: PeerProcess, dtype: str) -> Arm:
    return Arm(process.name, dtype, lambda: process.search_ms(dtype))


def _take_turns(arms: Sequence[Arm], plans: int, left_out: dict[str, str]) -> Times:
    """Milliseconds of each arm's searches; an arm that fails is left out."""
    times: Times = {(arm.planner, arm.dtype): [] for arm in arms}
    for _ in range(WARM_UP_PLANS + plans):
        for arm in arms:
            if arm.planner not in left_out:
                with left_out_on_error(arm.planner, left_out):
                    times[arm.planner, arm.dtype].append(arm.search_ms())
    return {key: laps[WARM_UP_PLANS:] for key, laps in times.items() if key[0] not in left_out}
