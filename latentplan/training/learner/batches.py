"""Batches from replay, served to Lightning."""

from __future__ import annotations

from collections.abc import Iterator

import lightning
import numpy as np
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset

from latentplan.config import Config, derive_seed
from latentplan.replay.buffer import Batch, Replay
from latentplan.training.learner.curriculum import Curriculum
from latentplan.training.learner.graphed import GraphedLearner
from latentplan.training.learner.module import Learner


class ReplayBatches(IterableDataset[Batch | Tensor]):
    """The updates of one epoch: reads replay, so that nothing is fetched past a collection.

    Sequences, or no more than the rows where they live, for a learner that gathers them itself.

    Args:
        replay: Where sequences are drawn from.
        config: Settings of the run.
        curriculum: What their rewards are.
        learner: Whose updates they are: an epoch after a resumption draws other sequences than the one before.
    """

    def __init__(self, replay: Replay, config: Config, curriculum: Curriculum, learner: Learner) -> None:
        self.replay, self.config, self.curriculum, self.learner = replay, config, curriculum, learner
        self.length = max(1, round(config.collection.round_decisions * config.collection.updates_per_decision))

    def __len__(self) -> int:
        """Updates per epoch."""
        return self.length

    def __iter__(self) -> Iterator[Batch | Tensor]:
        """Draw the batches of this epoch, each when it is asked for."""
        if self.curriculum.state.interrupted and not self.replay.written.any():  # there is nothing to draw from
            return
        learning = self.config.learning
        rng = np.random.default_rng(derive_seed(self.config.run.seed, "batches", self.learner.updates))
        gathers = isinstance(self.learner, GraphedLearner)
        for _ in range(self.length):
            rows = self.replay.draw(learning.batch_size, learning.sequence_length, rng)
            yield rows if gathers else self.curriculum(self.replay.gather(rows))


class ReplayData(lightning.LightningDataModule):
    """Serves `ReplayBatches` unchanged: they are batches already, on the right device."""

    def __init__(self, batches: ReplayBatches) -> None:
        super().__init__()
        self.batches = batches

    def train_dataloader(self) -> DataLoader[Batch | Tensor]:
        """A loader that neither collates nor prefetches."""
        return DataLoader(self.batches, batch_size=None, num_workers=0)
