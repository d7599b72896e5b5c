"""The learner on a GPU: its whole update as one CUDA graph."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from latentplan.config import LearningConfig, derive_seed
from latentplan.models import WorldModel
from latentplan.replay.buffer import Batch, Replay
from latentplan.training.learner.module import Learner, refreshed
from latentplan.training.learner.optimization import descend_if_finite

if TYPE_CHECKING:
    from latentplan.config import Config
    from latentplan.training.learner.curriculum import Curriculum

WARM_UP_UPDATES = 3  # before the recording: libraries choose their kernels, and optimizers make their state


class GraphedLearner(Learner):
    """Learns what `Learner` does, in one thread and one CUDA graph: recorded once, replayed for other sequences.

    `training_step` takes rows of replay, (batch, time + 1), instead of a batch. Gathering, augmentation, both losses,
    clipping, both optimizers, the slow target, averages and the refreshed beliefs are all in the graph, which
    reads nothing back to the host. So it cannot raise: an update whose gradient is not finite changes no weights, and
    `catch_up` says so. On a CPU nothing is recorded; the same update is run as it is.

    Args:
        model: What is learned.
        config: Losses and optimizers.
        discount: Per decision.
        replay: On the model's device.
        seed: Of the noise of posterior, prior and actor samples.
        prepare: What becomes of gathered sequences before they are learned from; recorded as it is then, so that it may
            change where values are forgotten and nowhere else.
    """

    skipped: Tensor

    def __init__(
        self,
        model: WorldModel,
        config: LearningConfig,
        discount: float,
        replay: Replay,
        seed: int,
        prepare: Callable[[Batch], Batch],
    ) -> None:
        super().__init__(model, config, discount, replay, seed)
        self.prepare = prepare
        self.register_buffer("skipped", torch.zeros((), dtype=torch.long), persistent=False)
        self._rows = torch.zeros(config.batch_size, config.sequence_length + 1, dtype=torch.long, device=replay.device)
        self._generator: torch.Generator | None = None
        self._graph: torch.cuda.CUDAGraph | None = None
        self._outputs: dict[str, Tensor] = {}
        self._written = [*self.model.parameters(), *self.averaged.parameters()]
        self._run_before, self._since_told = 0, 0

    def training_step(self, rows: Tensor, batch_index: int) -> None:  # type: ignore[override]
        """One update of the world model and of behaviour from the sequences at rows of replay (batch, time + 1)."""
        if self._generator is None:
            self._generator = torch.Generator(self.device)
        self._rows.copy_(rows)
        records = self.device.type == "cuda" and self._graph is None and self._run_before == WARM_UP_UPDATES
        if records:
            self._graph = self._record(self._generator)
        self._generator.manual_seed(derive_seed(self.seed, "update", self.updates))
        if self._graph is not None:
            self._graph.replay()
            # What keeps copies of weights until they change sees it by this count, which a graph leaves alone.
            torch.autograd.graph.increment_version(self._written)
        elif self.device.type == "cuda":
            self._run_aside()
        else:
            self._outputs = self.update(self._generator)
        self.updates += 1
        self._since_told += 1
        self.metrics |= self._outputs

    def update(self, generator: torch.Generator) -> dict[str, Tensor]:
        """What is recorded; the parts of the losses and the norms of the gradients, by name."""
        batch = self.prepare(self.replay.gather(self._rows))
        learned, batch, unturned = self._learn_model(batch, generator)
        is_finite = torch.isfinite(learned.parts["model_grad_norm"])
        self.replay.refresh(batch.rows, learned.states.deter, refreshed(batch, unturned & is_finite))
        self.snapshot.refresh()
        parts = learned.parts | self._learn_behaviour(learned, batch, generator)
        self.skipped += ~(is_finite & torch.isfinite(parts["behaviour_grad_norm"]))
        return parts

    def catch_up(self) -> None:
        """Say what was skipped since the last time; behaviour is up to date.

        Raises:
            FloatingPointError: No update since then had finite gradients.
        """
        updates, skipped = self._since_told, int(self.skipped)
        self._since_told = 0
        self.skipped.zero_()
        if skipped == 0:
            return
        told = (
            f"{skipped} of the last {updates} updates, up to update {self.updates}, had gradients that are not finite"
        )
        if skipped == updates:
            raise FloatingPointError(told)
        warnings.warn(f"{told}: they were skipped", RuntimeWarning, stacklevel=2)

    def forget_values(self) -> None:
        """As `Learner` does; what has been recorded holds the state of the optimizer that is forgotten."""
        super().forget_values()
        self._graph, self._run_before = None, 0

    def _descend(self, optimizer: torch.optim.Optimizer, loss: Tensor) -> Tensor:
        return descend_if_finite(optimizer, loss, self.config.max_grad_norm)

    def _run_aside(self) -> None:
        """An update in a stream of its own, as recording wants those before it to be."""
        assert self._generator is not None
        stream, own = torch.cuda.current_stream(self.device), torch.cuda.Stream(self.device)
        own.wait_stream(stream)
        with torch.cuda.stream(own):
            self._outputs = self.update(self._generator)
        stream.wait_stream(own)
        self._run_before += 1

    def _record(self, generator: torch.Generator) -> torch.cuda.CUDAGraph:
        graph = torch.cuda.CUDAGraph()
        graph.register_generator_state(generator)
        with torch.cuda.graph(graph):
            self._outputs = self.update(generator)
        return graph


def make_learner(model: WorldModel, config: Config, discount: float, replay: Replay, curriculum: Curriculum) -> Learner:
    """The learner that a run's settings ask for.

    Args:
        model: What is learned, where it stays.
        config: Settings of the run.
        discount: Per decision.
        replay: Of the run.
        curriculum: What rewards are learned.
    """
    settings, seed = config.learning, derive_seed(config.run.seed, "learner")
    if settings.cuda_graph and model.device.type == "cuda":
        return GraphedLearner(model, settings, discount, replay, seed, curriculum)
    return Learner(model, settings, discount, replay, seed)
