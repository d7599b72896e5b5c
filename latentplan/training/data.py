"""Batches from replay, served to Lightning."""

from __future__ import annotations

from collections.abc import Iterator

import lightning
import numpy as np
from torch.utils.data import DataLoader, IterableDataset

from latentplan.config import LearningConfig, derive_seed
from latentplan.replay import Batch, Replay
from latentplan.training.state import RunState


class ReplayBatches(IterableDataset[Batch]):
    """The updates of one epoch: reads replay, so that nothing is fetched past a collection."""

    def __init__(self, replay: Replay, config: LearningConfig, state: RunState, seed: int, length: int) -> None:
        self.replay, self.config, self.state, self.seed, self.length = replay, config, state, seed, length

    def __len__(self) -> int:
        """Updates per epoch."""
        return self.length

    def __iter__(self) -> Iterator[Batch]:
        """Draw the batches of this epoch, each when it is asked for."""
        rng = np.random.default_rng(derive_seed(self.seed, "batches", self.state.rounds))
        for _ in range(self.length):
            yield self.replay.sample(self.config.batch_size, self.config.sequence_length, rng)


class ReplayData(lightning.LightningDataModule):
    """Serves `ReplayBatches` unchanged: they are batches already, on the right device."""

    def __init__(self, batches: ReplayBatches) -> None:
        super().__init__()
        self.batches = batches

    def train_dataloader(self) -> DataLoader[Batch]:
        """A loader that neither collates nor prefetches."""
        return DataLoader(self.batches, batch_size=None, num_workers=0)
