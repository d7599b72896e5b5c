"""Milliseconds and floating-point operations of one update of the learner, on synthetic replay."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from statistics import median
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import FlopCounterMode

from bench.machine import read_clock
from latentplan.config import Config
from latentplan.models import WorldModel
from latentplan.models.backend import Backend
from latentplan.models.fast import accelerate
from latentplan.replay.buffer import Batch, Replay, Rows
from latentplan.training.learner.graphed import WARM_UP_UPDATES as GRAPH_WARM_UP_UPDATES
from latentplan.training.learner.graphed import GraphedLearner
from latentplan.training.learner.module import Learner

NUM_ROWS = 4096
WARM_UP_UPDATES = 2
DISCOUNT = 0.99  # the time does not depend on it
PARTS = ("sample", "encode", "recurrence", "decode", "heads", "behaviour", "optimizer", "other")
Lap = dict[str, float]
Parts = dict[str, Callable[[], Any]]


class OwnOptimizers:
    """Mixin of a learner that holds its own optimizers, so that it updates without a Trainer."""

    own_optimizers: list[torch.optim.Optimizer]

    def optimizers(self, use_pl_optimizer: bool = True) -> Any:
        """The optimizers, without a wrapper of Lightning."""
        return self.own_optimizers


class StandaloneLearner(OwnOptimizers, Learner):
    """A learner that updates without a Trainer."""

    def step_in_turn(self, batch: Batch) -> None:
        """Runs both halves of an update one after the other in one thread, so that each can be timed and counted."""
        self.training_step(batch, 0)
        assert self._waiting is not None
        waiting, self._waiting = self._waiting, None
        self._learn_behaviour(*waiting)


class StandaloneGraph(OwnOptimizers, GraphedLearner):
    """A learner that updates without a Trainer, with each update in one CUDA graph."""


class PhaseMeter:
    """Splits an update at the steps of its optimizers, and adds the reading of a meter to each phase.

    Args:
        learner: The learner, with the optimizers of world model and behaviour in this order.
        read: Returns the reading of the meter, in seconds or operations.
    """

    def __init__(self, learner: StandaloneLearner, read: Callable[[], float]) -> None:
        self.read, self.last, self.lap = read, 0.0, Lap()
        self._handles = []
        for phase, optimizer in zip(("model", "behaviour"), learner.own_optimizers, strict=True):
            before = optimizer.register_step_pre_hook(lambda *_, phase=phase: self.mark(phase))
            after = optimizer.register_step_post_hook(lambda *_: self.mark("optimizer"))
            self._handles += [before, after]

    def start(self) -> None:
        """Begins a lap."""
        self.last, self.lap = self.read(), Lap()

    def mark(self, phase: str) -> None:
        """Adds the reading since the last mark to a phase."""
        shown = self.read()
        self.lap[phase] = self.lap.get(phase, 0.0) + shown - self.last
        self.last = shown

    def skip(self) -> None:
        """Drops the reading since the last mark."""
        self.last = self.read()

    def close(self) -> None:
        """Removes the hooks from the optimizers."""
        for handle in self._handles:
            handle.remove()


def measure_update(config: Config, action_dim: int, device: torch.device, updates: int) -> dict[str, Any]:
    """Time and operations of an update of the learner with these settings.

    `update_ms` is the time in a training run, where the two halves of an update overlap; `in_turn_ms` is the time of
    the halves one after the other. `sample`, `behaviour`, `optimizer` and `other` are timed within `in_turn_ms`;
    `encode`, `recurrence` and `decode` are run alone, forward and backward, on the same batch, and `heads` is the rest
    of the world model's loss, including the gradient clipping.

    Returns:
        Plain values: `parts` (ms and counted operations of each), `update_ms`, `graph_ms` (the same update as one CUDA
        graph; None on a CPU), `flop`, `flop_per_s`, `updates_per_s`, `frames_per_s`, `parameters` and the sizes. Times
        are medians.
    """
    torch.manual_seed(0)
    replay = synthetic_replay(config, action_dim, device)
    model = accelerate(WorldModel(config.model, action_dim).to(device))
    learner = StandaloneLearner(model, config.learning, DISCOUNT, replay, seed=0).to(device)
    learner.own_optimizers = learner.configure_optimizers()
    alone = _parts_alone(model, _sample(learner, np.random.default_rng(3)))
    laps, flop = _measure_laps(learner, alone, device, updates), _count_lap(learner, alone)
    parts = {name: {"ms": 1000.0 * median(lap[name] for lap in laps), "flop": int(flop.get(name, 0))} for name in PARTS}
    seconds, in_turn = (median(lap[name] for lap in laps) for name in ("update", "in_turn"))
    sizes = config.learning
    return {
        "batch_size": sizes.batch_size,
        "sequence_length": sizes.sequence_length,
        "parameters": sum(parameter.numel() for parameter in model.parameters()),
        "updates": updates,
        "update_ms": 1000.0 * seconds,
        "in_turn_ms": 1000.0 * in_turn,
        "graph_ms": measure_graph(config, action_dim, device, updates) if device.type == "cuda" else None,
        "updates_per_s": 1.0 / seconds,
        "frames_per_s": sizes.batch_size * (sizes.sequence_length + 1) / seconds,
        "flop": int(flop["in_turn"]),
        "flop_per_s": flop["in_turn"] / seconds,
        "parts": parts,
    }


def measure_graph(config: Config, action_dim: int, device: torch.device, updates: int) -> float:
    """Median milliseconds of an update with `learning.cuda_graph`; on a CPU the same update without a graph."""
    replay = synthetic_replay(replace(config, replay=replace(config.replay, on_device=True)), action_dim, device)
    model = accelerate(WorldModel(config.model, action_dim).to(device))
    learner = StandaloneGraph(model, config.learning, DISCOUNT, replay, 0, lambda batch: batch).to(device)
    learner.own_optimizers = learner.configure_optimizers()
    rng, seconds = np.random.default_rng(1), []
    for _ in range(GRAPH_WARM_UP_UPDATES + 1 + updates):  # after the warm-up, one update records the graph
        rows = replay.draw(config.learning.batch_size, config.learning.sequence_length, rng)
        started = read_clock(device)
        learner.training_step(rows, 0)
        seconds.append(read_clock(device) - started)
    learner.catch_up()
    return 1000.0 * median(seconds[-updates:])


def synthetic_replay(config: Config, action_dim: int, device: torch.device) -> Replay:
    """A replay of random frames, actions and rewards, in episodes that are four sequences long."""
    storage = device if config.replay.on_device else torch.device("cpu")
    length = config.learning.sequence_length
    num_rows = max(NUM_ROWS, 8 * length)
    replay = Replay(num_rows, action_dim, config.model.deter_dim, 1, storage)
    rng = np.random.default_rng(0)
    rows = Rows(
        frames=rng.integers(0, 256, (num_rows, 64, 64, 3), dtype=np.uint8),
        deter=np.zeros((num_rows, config.model.deter_dim), np.float32),
        actions=rng.uniform(-1.0, 1.0, (num_rows, action_dim)).astype(np.float32),
        rewards=rng.uniform(0.0, 1.0, num_rows).astype(np.float32),
        continues=np.ones(num_rows, np.float32),
        is_first=np.arange(num_rows) % (4 * length) == 0,
        labels=np.zeros((num_rows, 0), np.float32),
    )
    replay.add(0, rows)
    return replay


def _measure_laps(learner: StandaloneLearner, alone: Parts, device: torch.device, updates: int) -> list[Lap]:
    """Seconds of each part; updates and parts run alone take turns, so that a busy machine slows down both."""
    meter = PhaseMeter(learner, lambda: read_clock(device))
    rng = np.random.default_rng(1)
    laps = []
    for _ in range(WARM_UP_UPDATES + updates):
        lap = _measure_lap(learner, alone, meter, rng)
        laps.append({**lap, "update": lap["sample"] + _overlapped_seconds(learner, device, rng)})
    meter.close()
    return laps[WARM_UP_UPDATES:]


def _count_lap(learner: StandaloneLearner, alone: Parts) -> Lap:
    """Operations of each part, counted on the reference, because torch does not see into compiled functions."""
    for model in (learner.model, learner.snapshot.model):
        model.backend = Backend(model.trunk_dtype)
    with FlopCounterMode(display=False) as counter:
        meter = PhaseMeter(learner, lambda: float(counter.get_total_flops()))
        lap = _measure_lap(learner, alone, meter, np.random.default_rng(2))
    meter.close()
    return lap


def _measure_lap(learner: StandaloneLearner, alone: Parts, meter: PhaseMeter, rng: np.random.Generator) -> Lap:
    meter.start()
    batch = _sample(learner, rng)
    meter.mark("sample")
    learner.step_in_turn(batch)
    meter.mark("other")
    in_turn = sum(meter.lap.values())
    for name, forward in alone.items():
        learner.model.zero_grad(set_to_none=True)
        meter.skip()
        _run_backward(forward())
        meter.mark(name)
    heads = meter.lap["model"] - sum(meter.lap[name] for name in alone)
    return {**meter.lap, "heads": heads, "in_turn": in_turn}


def _overlapped_seconds(learner: StandaloneLearner, device: torch.device, rng: np.random.Generator) -> float:
    """Seconds of an update as in a run: behaviour learns from the previous batch while the model learns."""
    learner.training_step(_sample(learner, rng), 0)
    batch, started = _sample(learner, rng), read_clock(device)
    learner.training_step(batch, 0)
    seconds = read_clock(device) - started
    learner.catch_up()
    return seconds


def _sample(learner: StandaloneLearner, rng: np.random.Generator) -> Batch:
    config = learner.config
    batch = learner.replay.gather(learner.replay.draw(config.batch_size, config.sequence_length, rng))
    return Batch(*(part.to(learner.device) for part in batch))


def _parts_alone(model: WorldModel, batch: Batch) -> Parts:
    """Forward passes of encoder, recurrence and decoder."""
    frames = batch.frames.flatten(0, 1)
    features = torch.randn(len(frames), model.config.deter_dim + model.config.latent_dim, device=frames.device)
    noise = torch.randn(*batch.rows.shape, model.config.latent_dim, device=frames.device)
    with torch.no_grad():
        embeddings = model.encoder(frames).unflatten(0, tuple(batch.rows.shape)).float()

    def encode() -> Tensor:
        with model.trunk_precision():
            return model.backend.encode(model, frames)

    def recur() -> Any:
        return model.backend.observe(model, embeddings.requires_grad_(), batch.actions, batch.deter, noise)

    def decode() -> Tensor:
        with model.trunk_precision():
            return model.backend.reconstruction_errors(model, features.requires_grad_(), frames)

    return {"encode": encode, "recurrence": recur, "decode": decode}


def _run_backward(outputs: Any) -> None:
    leaves = [leaf for leaf in tree_leaves(outputs) if leaf.requires_grad]
    torch.autograd.backward(leaves, [torch.ones_like(leaf) for leaf in leaves])
