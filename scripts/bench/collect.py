"""`benchmark.py collect`: frames per second of several workers that collect for one learner, and a model of the cost.

Workers collect rounds as in a run, with a learner that does nothing but ask for the next round. A round of D decisions
by K workers on C cores takes a + b K + c D / min(K, C) seconds, where a, b and c are fitted (least squares): a is what
a round costs however small it is, b is what each worker costs the learner, and c is the time of one decision on one
core. Numbers of workers that are held out test the fit. For a cluster, `limits` are the numbers of workers at which
each part of it is busy all the time.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

from bench.options import ComposeRequest, compute_on_processor
from bench.report import format_number, format_table, write_json
from latentplan.config import UserError
from latentplan.config.checks import above_zero, at_least
from latentplan.config.extras import require_extra
from latentplan.config.learning import COLLECTION_BACKENDS, MAX_WORKERS, CollectionBackend
from latentplan.config.parsing import option, require_known
from latentplan.config.settings import RenderQuality

if TYPE_CHECKING:
    from latentplan.config import Config
    from latentplan.training.collection.crew import Worker

WARM_UP = 2  # rounds before the timed ones, in which environments begin and weights arrive for the first time


@dataclass(frozen=True, kw_only=True)
class Request(ComposeRequest):
    """Flags of `benchmark.py collect`.

    Attributes:
        backends: Kinds of workers, `process` or `ray`.
        workers: Numbers of workers from which the model is fitted, at least three, each in [1, 256].
        held_out: Numbers of workers that the fitted model predicts, each in [1, 256].
        decisions: Decisions of a round, one measurement for each.
        rounds: Timed rounds of each measurement.
        quality: Render quality.
        ray_address: Address of a Ray cluster as HOST:PORT, for the workers of `ray`; None starts Ray on this machine.
        learners: Learning processes of the cluster to predict.
        collectors: Workers of that cluster, one core each.
        update_ms: Milliseconds of an update on one of its learners, from `benchmark.py train`.
        link_gbit: Speed of the network between its machines, in Gbit/s.
        json: Result as JSON.
    """

    backends: tuple[CollectionBackend, ...] = option(("process", "ray"), separator=",")
    workers: tuple[int, ...] = option((1, 2, 4), separator=",")
    held_out: tuple[int, ...] = option((3,), separator=",")
    decisions: tuple[int, ...] = option((250, 1000), separator=",")
    rounds: int = 7
    quality: RenderQuality = "fastest"
    ray_address: str | None = option(None, metavar="HOST:PORT")
    learners: int = 8
    collectors: int = 256
    update_ms: float = 10.0
    link_gbit: float = 10.0
    json: Path | None = option(None, metavar="FILE", is_output=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        compute_on_processor(self)
        at_least(self, rounds=1, learners=1, collectors=1)
        for name in ("workers", "held_out"):
            for number in getattr(self, name):
                if not 1 <= number <= MAX_WORKERS:
                    raise ValueError(f"{name} must be in [1, {MAX_WORKERS}], got {number}")
        if min(self.decisions) < 1:
            raise ValueError(f"decisions must be at least 1, got {min(self.decisions)}")
        if len(set(self.workers)) < 3:
            raise UserError("--workers must name at least three numbers, from which the model is fitted")
        if both := set(self.workers) & set(self.held_out):
            raise UserError(f"--held-out must name other numbers than --workers, got {min(both)} in both")
        above_zero(self, "update_ms", "link_gbit")
        require_known("backend", self.backends, COLLECTION_BACKENDS)
        if self.ray_address is not None and "ray" not in self.backends:
            raise UserError("--ray-address has no effect here: name ray in --backends too")


def run(request: Request) -> int:
    """Measures every number of workers, fits the model, and prints both."""
    from latentplan.config.estimates import count_cores

    if "ray" in request.backends:
        require_extra("--backends ray", "ray")
    request.use_device(1)
    composed = request.compose({})
    config = replace(composed, env=replace(composed.env, render_quality=request.quality))
    cores, result = count_cores(), {}
    for backend in request.backends:
        rows = list(measure(config, request, backend))
        model = fit([row for row in rows if row["workers"] in request.workers], cores)
        print_rows(backend, rows, model, cores)
        cluster = predict_cluster(model, rows[-1], config, request)
        result[backend] = {"rows": rows, "model": model, "cluster": cluster}
        print_cluster(cluster, request)
        write_json(request.json, {"cores": cores, "quality": request.quality, "backends": result})
    return 0


def measure(config: Config, request: Request, backend: CollectionBackend) -> Iterator[dict[str, Any]]:
    """One row for each number of workers and size of a round."""
    import torch

    from latentplan.training.collection.crew import make_worker

    for workers in (*request.workers, *request.held_out):
        collection = replace(config.collection, backend=backend, workers=workers, overlap=True)
        address = request.ray_address if backend == "ray" else None
        settings = replace(config, collection=collection, run=replace(config.run, ray_address=address))
        worker = make_worker(settings, None, torch.device("cpu"), lambda: False)
        try:
            worker.submit("describe")
            weights = copy_model(settings, worker.result())
            for decisions in request.decisions:
                yield {"workers": workers, "decisions": decisions} | time_rounds(
                    worker, weights, decisions, request.rounds
                )
        finally:
            worker.close()


def copy_model(config: Config, facts: Any) -> dict[str, Any]:
    """Weights of an untrained world model, as a learner sends them."""
    from latentplan.models import WorldModel
    from latentplan.training.callbacks import copy_weights

    return copy_weights(WorldModel(config.model, facts.action_dim, facts.labels, spaces=facts.spaces))


def time_rounds(worker: Worker, weights: dict[str, Any], decisions: int, rounds: int) -> dict[str, Any]:
    """Median times of rounds of the actor, after those that warm up, and the frames per second of all of them."""
    wall, own, frames, size = [], [], [], 0
    for number in range(WARM_UP + rounds):
        started = time.perf_counter(), time.process_time()
        worker.submit("collect", weights, "actor", decisions, number)
        collected = worker.result()
        wall.append(time.perf_counter() - started[0])
        own.append(time.process_time() - started[1])
        frames.append(collected.env_frames)
        size = sum(array.nbytes for rows in collected.rows for array in vars(rows).values())
    return {
        "round_s": median(wall[WARM_UP:]),
        "learner_s": median(own[WARM_UP:]),
        "frames_per_s": sum(frames[WARM_UP:]) / sum(wall[WARM_UP:]),
        "row_bytes": size / decisions,
        "weight_bytes": sum(array.nbytes for array in weights.values()),
    }


def fit(rows: Sequence[Mapping[str, Any]], cores: int) -> dict[str, float]:
    """The seconds `round`, `worker` and `decision` of the model above that come nearest to the rows, none below 0."""
    import numpy as np
    from scipy.optimize import nnls

    shares = [row["decisions"] / min(row["workers"], cores) for row in rows]
    terms = np.array([[1.0, row["workers"], share] for row, share in zip(rows, shares, strict=True)])
    weights = 1.0 / np.array([row["round_s"] for row in rows])  # errors count as shares of the time
    solution, _ = nnls(terms * weights[:, None], np.ones(len(rows)))
    return dict(zip(("round", "worker", "decision"), solution.tolist(), strict=True))


def predict(model: Mapping[str, float], workers: int, decisions: float, cores: int) -> float:
    """Seconds of a round."""
    return model["round"] + model["worker"] * workers + model["decision"] * decisions / min(workers, cores)


def predict_cluster(
    model: Mapping[str, float], row: Mapping[str, Any], config: Config, request: Request
) -> dict[str, Any]:
    """Rates of a cluster in which each worker has a core, and the workers at which each part reaches its limit.

    Every learner takes its share of each batch, and an update is taken to be no faster for it. Gradients travel around
    a ring once: 2 (N - 1) / N times their bytes. Rows travel to the learner, weights to each worker.

    Returns:
        Rates per second, and `limits` in workers. `joining` is None where the fitted time of a worker is 0; all limits
        and `bytes_per_s` are None where that of a decision is 0, as where rounds take no longer with more decisions.
    """
    workers, ranks = request.collectors, request.learners
    decisions = config.collection.round_decisions * workers
    link = request.link_gbit * 1e9 / 8.0
    gradient_s = 2.0 * (ranks - 1) / ranks * row["weight_bytes"] / link
    updates = 1.0 / (request.update_ms / 1000.0 + gradient_s)
    repeat, ratio = config.env.action_repeat, config.collection.updates_per_decision
    decision, worker = model["decision"], model["worker"]
    seconds = predict(model, workers, decisions, workers)
    bytes_per_decision = row["row_bytes"] + row["weight_bytes"] / config.collection.round_decisions
    limits = {
        "updates": updates / ratio * decision,
        "network": link / bytes_per_decision * decision,
        "joining": config.collection.round_decisions * decision / worker if worker else None,
    }
    return {
        "collected_frames_per_s": repeat * decisions / seconds,
        "learned_frames_per_s": repeat * updates / ratio,
        "updates_per_s": updates,
        "gradient_s": gradient_s,
        "bytes_per_s": workers * bytes_per_decision / decision if decision else None,
        "limits": limits if decision else dict.fromkeys(limits),
    }


def print_rows(backend: str, rows: Sequence[Mapping[str, Any]], model: Mapping[str, float], cores: int) -> None:
    """The measurements, beside what the model says."""
    single = {row["decisions"]: row["frames_per_s"] for row in rows if row["workers"] == 1}
    lines = []
    for row in rows:
        workers, decisions, rate = row["workers"], row["decisions"], row["frames_per_s"]
        ideal = single.get(decisions, float("nan")) * min(workers, cores)
        predicted = predict(model, workers, decisions, cores)
        lines.append(
            [f"{backend}, {workers} workers, {decisions} decisions", format_number(rate, 0)]
            + [format_number(100.0 * rate / ideal, 0), format_number(1000.0 * row["round_s"], 0)]
            + [format_number(1000.0 * predicted, 0), format_number(1000.0 * row["learner_s"], 1)]
        )
    header = ["", "frames/s", "% of 1 worker x cores", "round, ms", "by the model", "CPU of the learner, ms"]
    print(format_table(header, lines))
    parts = ", ".join(f"{name} {1000.0 * seconds:.3f}" for name, seconds in model.items())
    print(f"model in ms: {parts}", flush=True)


def print_cluster(cluster: Mapping[str, Any], request: Request) -> None:
    """The prediction for a cluster."""
    megabytes = None if cluster["bytes_per_s"] is None else cluster["bytes_per_s"] / 1e6
    print(
        f"{request.collectors} workers collect {cluster['collected_frames_per_s']:,.0f} frames/s, "
        f"{request.learners} learners use {cluster['learned_frames_per_s']:,.0f}; "
        f"{format_number(megabytes, 0)} MB/s arrive and leave"
    )
    limits = ", ".join(f"{part} {format_number(workers, 1)}" for part, workers in cluster["limits"].items())
    print(f"workers at which each part is at its limit: {limits}\n", flush=True)
