"""`benchmark.py saving`: what saves and guards take of the time of a training run.

A replay is filled and saved, and saved again after as many decisions as a run makes between two saves. Updates are made
in turns with and without the guards against values that are not finite. Times of updates are CPU times of this process,
which a busy machine disturbs less; times of saves are given on the wall clock too, as they wait for the disk.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

from bench.options import ComposeRequest, compute_on_processor
from bench.report import format_table, write_json
from latentplan.config.checks import at_least
from latentplan.config.parsing import option

if TYPE_CHECKING:
    from latentplan.config import Config

BLOCK = 5  # updates of one arm before the other arm takes over


@dataclass(frozen=True, kw_only=True)
class Request(ComposeRequest):
    """Flags of `benchmark.py saving`.

    Attributes:
        rows: Rows of the replay.
        new_rows: Rows that are new at a save.
        saves: Timed saves.
        blocks: Blocks of five updates of each arm.
        folder: Where the saves are written; None takes the folder for temporary files.
        json: Result as JSON.
    """

    rows: int = 100_000
    new_rows: int = 2_500
    saves: int = 5
    blocks: int = 10
    folder: Path | None = option(None, metavar="DIR")
    json: Path | None = option(None, metavar="FILE", is_output=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        compute_on_processor(self)
        at_least(self, rows=1, new_rows=1, saves=1, blocks=1)


def run(request: Request) -> int:
    """Times saves and guards, and prints their shares of the time of a run."""
    from latentplan.training.saving import SAVE_MINUTES

    config = request.compose({})
    request.use_device(1)
    with tempfile.TemporaryDirectory(dir=request.folder) as name:
        saves = time_saves(config, request, Path(name))
    guards = time_guards(config, request)
    seconds = 60.0 * SAVE_MINUTES
    share = {
        "saves_percent": 100.0 * median(saves["wall_s"][1:]) / seconds,
        "guards_percent": 100.0 * (guards["with_ms"] / guards["without_ms"] - 1.0),
    }
    rows = [
        ["first save", f"{saves['wall_s'][0]:.2f} s", f"{saves['cpu_s'][0]:.2f} s", "-"],
        ["later saves, median", f"{median(saves['wall_s'][1:]):.2f} s", f"{median(saves['cpu_s'][1:]):.2f} s"]
        + [f"{share['saves_percent']:.2f} %"],
        ["update without guards", "-", f"{guards['without_ms']:.1f} ms", "-"],
        ["update with guards", "-", f"{guards['with_ms']:.1f} ms", f"{share['guards_percent']:+.2f} %"],
    ]
    print(format_table(["", "wall clock", "CPU", "of the time"], rows))
    print(f"one save in {seconds:.0f} s, of {request.rows:,} rows of which {request.new_rows:,} are new")
    write_json(request.json, {"rows": request.rows, "new_rows": request.new_rows, **saves, **guards, **share})
    return 0


def time_saves(config: Config, request: Request, folder: Path) -> dict[str, Any]:
    """Seconds of each save of a replay and a learner's state, the first with all rows new."""
    import numpy as np
    import torch

    from latentplan.config.commit import Extent, Saves
    from latentplan.replay.buffer import Replay, Rows
    from latentplan.replay.disk import ReplayFiles

    action_dim, deter = 6, config.model.deter_dim
    replay = Replay(request.rows + request.saves * request.new_rows, action_dim, deter, 1, torch.device("cpu"))
    rng = np.random.default_rng(0)

    def add(count: int) -> None:
        for start in range(0, count, 500):
            size = min(count - start, 500)
            replay.add(
                0,
                Rows(
                    frames=rng.integers(0, 256, (size, 64, 64, 3), dtype=np.uint8),
                    deter=rng.normal(size=(size, deter)).astype(np.float32),
                    actions=np.zeros((size, action_dim), np.float32),
                    rewards=np.zeros(size, np.float32),
                    continues=np.ones(size, np.float32),
                    is_first=np.arange(size) == 0,
                    labels=np.zeros((size, 0), np.float32),
                ),
            )

    learner = make_learner(config, action_dim)
    state = {"learner": learner.state_dict(), "optimizers": [half.state_dict() for half in learner.optimizers()]}
    saves, files = Saves(folder, "run", 1), ReplayFiles(folder, replay)

    def write(part: Path) -> dict[str, Extent]:
        torch.save(state, part / "state.pt")
        return files.write(part)

    add(request.rows)
    wall, cpu = [], []
    for _ in range(1 + request.saves):
        before = time.perf_counter(), time.process_time()
        saves.commit(write, {})
        wall.append(time.perf_counter() - before[0])
        cpu.append(time.process_time() - before[1])
        add(request.new_rows)
    return {"wall_s": wall, "cpu_s": cpu}


def time_guards(config: Config, request: Request) -> dict[str, Any]:
    """CPU milliseconds of an update with and without guards: medians over blocks in turns."""
    import numpy as np
    from torch import Tensor

    from latentplan.training.learner.module import Learner
    from latentplan.training.learner.optimization import clipped_gradient

    learner = make_learner(config, 6)
    rng, size = np.random.default_rng(0), config.learning
    guarded = Learner._descend

    def unguarded(learner: Learner, half: int, loss: Tensor, parts: dict[str, Tensor], rows: Tensor) -> Tensor:
        optimizer = learner._optimizers()[half]
        optimizer.found_inf = None  # type: ignore[attr-defined]
        norm = clipped_gradient(optimizer, loss, size.max_grad_norm)
        optimizer.step()
        return norm

    times: dict[str, list[float]] = {"without_ms": [], "with_ms": []}
    for block in range(1 + request.blocks):
        for name, descend in (("without_ms", unguarded), ("with_ms", guarded)):
            Learner._descend = descend  # type: ignore[method-assign,assignment]
            started = time.process_time()
            for _ in range(BLOCK):
                rows = learner.replay.draw(size.batch_size, size.sequence_length, rng)
                learner.training_step(learner.replay.gather(rows), 0)
                learner.catch_up()
                if name == "with_ms":
                    sum(int(half.total) for half in learner.skips)  # as `Guard` looks at them
            if block:  # the first block warms up
                times[name].append(1000.0 * (time.process_time() - started) / BLOCK)
    Learner._descend = guarded  # type: ignore[method-assign,assignment]
    return {name: median(values) for name, values in times.items()} | {"blocks": times}


def make_learner(config: Config, action_dim: int) -> Any:
    """A learner with a small replay and its own optimizers, after one update."""
    import numpy as np
    import torch

    from bench.train_update import StandaloneLearner, synthetic_replay
    from latentplan.models import WorldModel
    from latentplan.models.fast import accelerate

    device = torch.device("cpu")
    replay = synthetic_replay(config, action_dim, device)
    model = accelerate(WorldModel(config.model, action_dim))
    learner = StandaloneLearner(model, config.learning, 0.99, replay, seed=0)
    learner.own_optimizers = learner.configure_optimizers()
    size = config.learning
    learner.training_step(
        replay.gather(replay.draw(size.batch_size, size.sequence_length, np.random.default_rng(1))), 0
    )
    learner.catch_up()
    return learner
