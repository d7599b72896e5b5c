"""The learner on a GPU: one update recorded as one CUDA graph."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from latentplan.config import LearningConfig, derive_seed
from latentplan.models import WorldModel
from latentplan.replay.buffer import Batch, Replay
from latentplan.training.learner.module import Learner, is_refreshed
from latentplan.training.ranks import ALONE, Ranks

if TYPE_CHECKING:
    from latentplan.config import Config
    from latentplan.training.learner.curriculum import Curriculum

WARM_UP_UPDATES = 3  # before the recording, while libraries choose kernels and optimizers create their state


class GraphedLearner(Learner):
    """Learns as `Learner` does, but in one thread, by replaying one recorded CUDA graph for each update.

    `training_step` takes rows of replay, (batch, time + 1), instead of a batch. The graph gathers and augments the
    sequences, computes both losses, steps both optimizers, updates the slow target and the averages, and stores the new
    beliefs. The graph reads nothing back to the host, so an update cannot raise: `skips` counts in the graph. On a CPU
    the same update runs without a graph.

    Args:
        model: The world model with actor and value head.
        config: Settings of losses and optimizers.
        discount: Discount per decision.
        replay: The replay, on the model's device.
        seed: Seed of the noise in posterior, prior and actor samples.
        prepare: Applied to gathered sequences. The graph records this function, so its effect may change only together
            with `reset_value_head`, which starts a new recording.
    """

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
        self._rows = torch.zeros(config.batch_size, config.sequence_length + 1, dtype=torch.long, device=replay.device)
        self._generator: torch.Generator | None = None
        self._graph: torch.cuda.CUDAGraph | None = None
        self._outputs: dict[str, Tensor] = {}
        self._recorded_parameters = [*self.model.parameters(), *self.averaged.parameters()]
        self._num_warm_up_updates = 0

    def training_step(self, rows: Tensor, batch_index: int) -> None:  # type: ignore[override]
        """Update world model and behaviour from the sequences at rows of replay, (batch, time + 1)."""
        if self._generator is None:
            self._generator = torch.Generator(self.device)
        self._rows.copy_(rows)
        can_record = self.model.backend.can_record(self.model)
        if can_record and self._graph is None and self._num_warm_up_updates == WARM_UP_UPDATES:
            self._graph = self._record(self._generator)
        self._generator.manual_seed(derive_seed(self.seed, "update", self.updates))
        if self._graph is not None:
            self._graph.replay()
            # Caches of weights watch the version counter, which a replayed graph does not increment.
            torch.autograd.graph.increment_version(self._recorded_parameters)
        elif can_record:
            self._warm_up(self._generator)
        else:
            self._outputs = self.update(self._generator)
        self.updates += 1
        self.metrics |= self._outputs

    def update(self, generator: torch.Generator) -> dict[str, Tensor]:
        """Computes one update, the part that the graph records; returns losses and gradient norms by name."""
        batch = self.prepare(self.replay.gather(self._rows))
        learned, batch, is_unturned = self._learn_model(batch, generator)
        is_finite = torch.isfinite(learned.parts["model_grad_norm"])
        self.replay.refresh(batch.rows, learned.states.deter, is_refreshed(batch, is_unturned & is_finite))
        self.snapshot.refresh()
        return learned.parts | self._learn_behaviour(learned, batch, generator)

    def catch_up(self) -> None:
        """Does nothing: no behaviour update is outstanding."""

    def reset_value_head(self) -> None:
        """Reset as `Learner` does, and drop the graph, because it uses the old optimizer state."""
        super().reset_value_head()
        self._graph, self._num_warm_up_updates = None, 0

    def _warm_up(self, generator: torch.Generator) -> None:
        """Run one update in a side stream, which CUDA requires of the updates before a recording."""
        stream, own = torch.cuda.current_stream(self.device), torch.cuda.Stream(self.device)
        own.wait_stream(stream)
        with torch.cuda.stream(own):
            self._outputs = self.update(generator)
        stream.wait_stream(own)
        self._num_warm_up_updates += 1

    def _record(self, generator: torch.Generator) -> torch.cuda.CUDAGraph:
        graph = torch.cuda.CUDAGraph()
        graph.register_generator_state(generator)
        with torch.cuda.graph(graph):
            self._outputs = self.update(generator)
        return graph


def make_learner(
    model: WorldModel,
    config: Config,
    discount: float,
    replay: Replay,
    curriculum: Curriculum,
    ranks: Ranks = ALONE,
) -> Learner:
    """Makes the learner that the settings select.

    With `learning.cuda_graph` a model whose updates can be recorded gets a `GraphedLearner`; any other model gets a
    `Learner`.

    Args:
        model: The world model, on its device.
        config: Settings of the run.
        discount: Discount per decision.
        replay: Replay of the run.
        curriculum: Replaces the rewards of replayed sequences.
        ranks: The processes that share each batch; with several, `Config` refuses `learning.cuda_graph`.
    """
    settings, seed = config.learning, derive_seed(config.run.seed, "learner")
    if settings.cuda_graph and model.backend.can_record(model):
        return GraphedLearner(model, settings, discount, replay, seed, curriculum)
    return Learner(model, settings, discount, replay, seed, ranks)
