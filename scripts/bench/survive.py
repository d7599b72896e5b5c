"""`benchmark.py survive`: tries and survivals of kills, of kills within the write of a save, and of flipped bits.

Toy runs are killed with SIGKILL at random moments after their first save and started again; each must end with the
weights, the optimizers, the replay, the evaluations and the metrics of a run that was never killed, which one checksum
covers. A process that does nothing but save is killed; a save that is whole must be there. Single bits are flipped in
every file that a resumed run or a loaded agent reads; each flip must be noticed.
"""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from bench.report import format_table, write_json
from bench.toy import Dot, find_worker, flip_bit, toy_config
from latentplan.config.checks import at_least
from latentplan.config.parsing import option

FRAMES = 300
KILLS_PER_RUN = 3
FILES = ("resume/save-*/*", "resume/logs/*", "config.yaml", "checkpoints/*/*")  # which the program reads


@dataclass(frozen=True, kw_only=True)
class Request:
    """Flags of `benchmark.py survive`.

    Attributes:
        trainer: Toy runs whose trainer is killed, up to three times each.
        worker: Toy runs whose collection process is killed, up to three times each.
        saves: Kills of a process that writes saves of a run.
        checkpoints: Kills of a process that writes checkpoints.
        flips: Flipped bits.
        decisions: Decisions of a run whose memory is measured.
        seed: Seed of moments and places.
        json: Result as JSON.
    """

    trainer: int = 25
    worker: int = 10
    saves: int = 100
    checkpoints: int = 100
    flips: int = 400
    decisions: int = 50_000
    seed: int = 0
    json: Path | None = option(None, metavar="FILE", is_output=True)

    def __post_init__(self) -> None:
        at_least(self, trainer=0, worker=0, saves=0, checkpoints=0, flips=0, decisions=0)


def run(request: Request) -> int:
    """Kills, flips and counts."""
    import torch

    torch.set_num_threads(1)
    rng = random.Random(request.seed)
    result: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory(prefix="survive-") as name:
        folder = Path(name)
        reference, seconds = folder / "reference", time.monotonic()
        _wait(_train(reference, overlap=False))
        seconds = time.monotonic() - seconds
        parts: dict[str, Callable[[], dict[str, Any]]] = {
            "kill -9 of the trainer": lambda: kill_runs(folder, reference, request.trainer, seconds, rng, False),
            "kill -9 of the worker": lambda: kill_runs(folder, reference, request.worker, seconds, rng, True),
            "kill -9 within a save": lambda: kill_saves(folder / "saves", request.saves, rng),
            "kill -9 within a checkpoint": lambda: kill_agents(folder / "agent", reference, request.checkpoints, rng),
            "flipped bits": lambda: flip_bits(reference, request.flips, rng),
        }
        for part, measure in parts.items():
            result[part] = measure()
            print(f"{part}: {result[part]}", flush=True)
        memory = measure_memory(folder / "memory", request.decisions) if request.decisions else {}
    header = ["", "tries", "survived"]
    print(format_table(header, [[part, str(row["tries"]), str(row["survived"])] for part, row in result.items()]))
    if memory:
        print(f"memory over {request.decisions:,} decisions: {memory}")
    write_json(request.json, {**result, "memory": memory})
    return 0 if all(row["tries"] == row["survived"] for row in result.values()) else 1


def kill_runs(
    folder: Path, reference: Path, tries: int, seconds: float, rng: random.Random, is_worker: bool
) -> dict[str, Any]:
    """Kills runs at random moments after their first save.

    Args:
        folder: Where the runs are made; one that fails is moved to a folder of its own, which is kept.
        reference: A run that was not killed.
        tries: Number of runs.
        seconds: Time that the reference took.
        rng: Chooses the moments.
        is_worker: Whether the collection process is killed in place of the trainer.

    Returns:
        Runs, runs that ended as the reference, and kills.
    """
    expected, kills, survived = fingerprint(reference), 0, 0
    for index in range(tries):
        own = folder / f"{'worker' if is_worker else 'trainer'}{index}"
        process, killed = _train(own, overlap=is_worker), 0
        while killed < KILLS_PER_RUN:
            _await_save(own / "resume", process)
            if _has_ended(process, rng.uniform(0.0, seconds)):
                break
            target = find_worker(process) if is_worker else process
            if target is None:
                time.sleep(0.01)
                continue
            with contextlib.suppress(ProcessLookupError):
                os.kill(target, signal.SIGKILL)
                kills, killed = kills + 1, killed + 1
            if not is_worker:
                _wait(process)
                process = _train(own, overlap=False)
        code = _wait(process)
        is_equal = code == 0 and fingerprint(own) == expected
        survived += is_equal
        if is_equal:
            shutil.rmtree(own)
        else:
            kept = shutil.move(own, tempfile.mkdtemp(prefix="survive-failed-"))  # the folder of all runs is removed
            print(f"run {index} ended with {code} and other results: {kept}", file=sys.stderr)
    return {"tries": tries, "survived": survived, "kills": kills}


def kill_saves(folder: Path, tries: int, rng: random.Random) -> dict[str, Any]:
    """Kills a process that adds rows to a replay and saves it, again and again."""
    from latentplan.config.commit import Saves

    survived = within = 0
    for _ in range(tries):
        process = _fork(lambda: _save_for_ever(folder))
        _await_save(folder, process)
        time.sleep(rng.uniform(0.0, 0.3))
        os.kill(process, signal.SIGKILL)
        _wait(process)
        within += bool(list(folder.glob("*.part")))
        _, problems = Saves(folder, "run", 1).newest()
        survived += not problems
    return {"tries": tries, "survived": survived, "with an unfinished save": within}


def kill_agents(folder: Path, reference: Path, tries: int, rng: random.Random) -> dict[str, Any]:
    """Kills a process that replaces a checkpoint, again and again."""
    from latentplan.agents.checkpoint import load_model, save_checkpoint

    model, config, info = load_model(reference)
    seen = survived = within = 0

    def save_for_ever() -> None:
        for count in range(seen + 1, sys.maxsize):
            save_checkpoint(folder, model, config, info | {"updates": count})

    for _ in range(tries):
        process = _fork(save_for_ever)
        while not (folder / "manifest.json").exists():
            time.sleep(0.002)
        time.sleep(rng.uniform(0.0, 0.05))
        os.kill(process, signal.SIGKILL)
        _wait(process)
        within += bool(list(folder.glob("*.part")))
        updates = load_model(folder)[2]["updates"]
        survived += updates >= seen
        seen = updates
    return {"tries": tries, "survived": survived, "with unfinished files": within}


def flip_bits(run: Path, tries: int, rng: random.Random) -> dict[str, Any]:
    """Flips single bits in the files of a run, one after the other, and takes each back."""
    paths = sorted(path for pattern in FILES for path in run.glob(pattern))
    noticed = 0
    for count in range(tries):
        path = paths[count % len(paths)]
        before = flip_bit(path, rng)
        if is_noticed(run, path):
            noticed += 1
        else:
            print(f"not noticed: {path}", file=sys.stderr)
        path.write_bytes(before)
    return {"tries": tries, "survived": noticed, "files": len(paths)}


def is_noticed(run: Path, path: Path) -> bool:
    """Whether the program notices a damaged file when it reads the run or the agent."""
    from latentplan.agents.checkpoint import load_model
    from latentplan.config import UserError
    from latentplan.config.run_folder import read_run_config, run_saves

    try:
        if "checkpoints" in path.parts:
            load_model(path.parent)
            return False
        if path.name == "config.yaml" and path.parent == run:
            return read_run_config(run)[1] is not None
        for save in (run / "resume").glob("save-*[0-9]"):
            if path.parent in (save, run / "resume" / "logs"):
                run_saves(run).verify(save)
        return False
    except UserError:
        return True


def measure_memory(folder: Path, decisions: int) -> dict[str, Any]:
    """Resident memory of a trainer, in MiB, after a tenth of its decisions and at their end."""
    process = _train(folder, overlap=True, decisions=decisions)
    samples: list[tuple[float, float]] = []
    while not _has_ended(process, 1.0):
        with contextlib.suppress(OSError, StopIteration, ValueError):
            lines = Path(f"/proc/{process}/status").read_text().splitlines()
            memory = next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmRSS"))
            rows = (folder / "metrics.csv").read_text().splitlines()
            samples.append((float(rows[-1].split(",")[1]), memory))
    early = [memory for done, memory in samples if 0.1 * decisions <= done <= 0.2 * decisions]
    late = [memory for done, memory in samples if done >= 0.9 * decisions]
    if not (early and late):
        return {"samples": len(samples)}
    first, last = sum(early) / len(early), sum(late) / len(late)
    return {"early_mib": round(first, 1), "late_mib": round(last, 1), "growth_percent": 100.0 * (last / first - 1.0)}


def fingerprint(run: Path) -> str:
    """Checksum of what a run has learned, collected and measured, without its times and restarts."""
    import csv
    import hashlib

    import torch

    save = max((run / "resume").glob("save-*[0-9]"))
    state = torch.load(save / "state.pt", weights_only=True)
    hasher = hashlib.sha256()
    with (run / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    parts = [state["learner"], state["optimizers"], state["memory"], state["run"], rows]
    parts += [torch.load(save / "rows.pt", weights_only=True)]
    parts += [path.read_bytes() for path in sorted((run / "resume" / "logs").iterdir())]
    for value in _leaves(parts):
        if isinstance(value, torch.Tensor):
            value = value.contiguous().numpy().tobytes()
        hasher.update(value if isinstance(value, bytes) else repr(value).encode())
    return hasher.hexdigest()


def _leaves(value: Any) -> Iterator[Any]:
    if isinstance(value, dict):
        for name, inner in value.items():
            if name not in ("minutes", "earlier_minutes", "worker_restarts"):
                yield from _leaves(inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from _leaves(inner)
    else:
        yield value


def _save_for_ever(folder: Path) -> None:
    import numpy as np
    import torch

    from latentplan.config.commit import Saves
    from latentplan.replay.buffer import Replay, Rows
    from latentplan.replay.disk import ReplayFiles

    replay, saves = Replay(200, 1, 16, 1, torch.device("cpu")), Saves(folder, "run", 1)
    files = ReplayFiles(folder, replay)
    if saves.exist():
        files.read(saves.newest()[0])
        saves.remove_leftovers()
    while True:
        count = 20
        replay.add(
            0,
            Rows(
                frames=np.random.default_rng().integers(0, 256, (count, 64, 64, 3), dtype=np.uint8),
                deter=np.zeros((count, 16), np.float32),
                actions=np.zeros((count, 1), np.float32),
                rewards=np.zeros(count, np.float32),
                continues=np.ones(count, np.float32),
                is_first=np.arange(count) == 0,
                labels=np.zeros((count, 0), np.float32),
            ),
        )
        saves.commit(files.write, {"rows": int(replay.written[0])})


def _train(folder: Path, *, overlap: bool, decisions: int | None = None) -> int:
    """Starts or continues a run in a process of its own, and returns its number."""

    def learn() -> None:
        from latentplan.training import resume, saving, train

        saving.SAVE_MINUTES = 0.0
        if (folder / "config.yaml").exists():
            resume(folder, make_env=Dot)
            return
        config = toy_config(folder, decisions or FRAMES, overlap=overlap, every_frames=decisions or 40)
        if decisions is not None:
            saving.SAVE_MINUTES = 1.0
            collection = replace(config.collection, round_decisions=250, updates_per_decision=0.1)
            config = replace(config, collection=collection, replay=replace(config.replay, capacity=5000))
        train(config, Dot)

    return _fork(learn)


def _fork(work: Callable[[], None]) -> int:
    """A child process that does some work in silence and ends; forked, so that libraries are loaded once."""
    import latentplan.training.run  # noqa: F401

    sys.stdout.flush()
    process = os.fork()
    if process:
        return process
    code = 1
    try:
        warnings.simplefilter("ignore")
        silent = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silent, 1)
        work()
        code = 0
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        os._exit(code)


def _wait(process: int) -> int:
    """The exit code of a child."""
    if process not in _ended:
        _ended[process] = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    return _ended[process]


_ended: dict[int, int] = {}  # exit codes of children that were looked at


def _has_ended(process: int, seconds: float = 0.0) -> bool:
    """Whether a child ends within some seconds."""
    end = time.monotonic() + seconds
    while process not in _ended:
        number, status = os.waitpid(process, os.WNOHANG)
        if number:
            _ended[process] = os.waitstatus_to_exitcode(status)
        elif time.monotonic() >= end:
            return False
        else:
            time.sleep(0.002)
    return True


def _await_save(folder: Path, process: int) -> None:
    """Wait for the first save of a process that has not ended."""
    while not list(folder.glob("save-*[0-9]")) and not _has_ended(process):
        time.sleep(0.002)
