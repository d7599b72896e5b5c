"""Batches of replayed sequences for Lightning."""

from __future__ import annotations

from collections.abc import Iterator

import lightning
import numpy as np
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset

from latentplan.config import CollectionConfig, Config, derive_seed
from latentplan.replay.buffer import Batch, Replay
from latentplan.training.learner.curriculum import Curriculum
from latentplan.training.learner.graphed import GraphedLearner
from latentplan.training.learner.module import Learner


class ReplayBatches(IterableDataset[Batch | Tensor]):
    """The batches of one epoch, each drawn from replay when Lightning asks for it.

    A plain learner gets sequences; a `GraphedLearner`, which gathers sequences itself, gets rows (batch, time + 1).

    Args:
        replay: Source of the sequences.
        config: Settings of the run.
        curriculum: Replaces the rewards of the sequences.
        learner: Receives the batches; its number of updates seeds the draws of an epoch. A run that resumes within an
            epoch draws the batches again that it has learned from, and drops them.
    """

    def __init__(self, replay: Replay, config: Config, curriculum: Curriculum, learner: Learner) -> None:
        self.replay, self.config, self.curriculum, self.learner = replay, config, curriculum, learner
        self.length = updates_per_epoch(config.collection)

    def __len__(self) -> int:
        """Updates per epoch."""
        return self.length

    def __iter__(self) -> Iterator[Batch | Tensor]:
        """Draws the batches of this epoch one by one."""
        state, learning = self.curriculum.state, self.config.learning
        if not state.in_epoch:
            return  # the run was interrupted before the epoch began
        done = self.learner.updates
        first = done - state.epoch_updates
        ranks = self.learner.ranks
        seed = ranks.own_config(self.config).run.seed
        rng = np.random.default_rng(derive_seed(seed, "batches", first))
        takes_rows = isinstance(self.learner, GraphedLearner)
        budget = self.config.run.updates
        end = first + self.length if budget is None else min(first + self.length, budget)
        for update in range(first, end):
            rows = self.replay.draw(learning.batch_size // ranks.size, learning.sequence_length, rng)
            if update >= done:
                yield rows if takes_rows else self.curriculum(self.replay.gather(rows))


def updates_per_epoch(collection: CollectionConfig) -> int:
    """Updates that follow a round of collection, at least 1."""
    return max(1, round(collection.round_decisions * collection.updates_per_decision))


class ReplayData(lightning.LightningDataModule):
    """Serves `ReplayBatches` unchanged, because their batches are already on the right device.

    Args:
        batches: The batches of every epoch.
    """

    def __init__(self, batches: ReplayBatches) -> None:
        super().__init__()
        self.batches = batches

    def train_dataloader(self) -> DataLoader[Batch | Tensor]:
        """A loader without collation, worker processes or prefetching."""
        return DataLoader(self.batches, batch_size=None, num_workers=0)
