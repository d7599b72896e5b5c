"""A program of one rank: makes updates on its share of fixed batches, and writes the losses of every update to a file.

The environment variables of torch.distributed say which rank it is; without them one process makes the same updates
alone. Arguments: the number of updates, and the file.
"""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from latentplan.models import WorldModel
from latentplan.models.fast import accelerate
from latentplan.models.fast.native import find_kernels
from latentplan.replay.buffer import Replay, Rows
from latentplan.training.learner.module import Learner
from latentplan.training.ranks import join_ranks, place_ranks
from tests.training.conftest import TINY

BATCH, LENGTH, LANE_ROWS, LANES = TINY.learning.batch_size, TINY.learning.sequence_length, 60, 2
LABELS = {"height": 0.5}
CALM = {  # rounding errors grow slowly, on every processor
    "representation_scale": 0.02,
    "entropy_scale": 1e-3,
    "gradient_decay": 1.0,
    "model_learning_rate": 1e-4,
    "behaviour_learning_rate": 3e-5,
}
SPOILT = 25  # the update in which a reward is not a number


class Standalone(Learner):
    """A learner with its own optimizers, which updates without a Trainer."""

    def optimizers(self, use_pl_optimizer=True):
        self.__dict__.setdefault("own", self.configure_optimizers())
        return self.own


def make_rows(lane):
    """Episodes of 12 rows; every other one ends in a terminal state, so that ranks have masks of different sizes."""
    rng = np.random.default_rng(lane)
    place = np.arange(LANE_ROWS)
    is_terminal = (place % 12 == 10) & (place // 12 % 2 == lane)
    return Rows(
        frames=rng.integers(0, 256, (LANE_ROWS, 64, 64, 3), dtype=np.uint8),
        deter=rng.normal(size=(LANE_ROWS, TINY.model.deter_dim)).astype(np.float32),
        actions=rng.uniform(-1.0, 1.0, (LANE_ROWS, 1)).astype(np.float32),
        rewards=rng.uniform(0.0, 1.0, LANE_ROWS).astype(np.float32),
        continues=1.0 - is_terminal.astype(np.float32),
        is_first=place % 12 == 0,
        labels=rng.uniform(-0.1, 0.1, (LANE_ROWS, len(LABELS))).astype(np.float32),
    )


def make_replay(lanes):
    replay = Replay(LANE_ROWS * len(lanes), 1, TINY.model.deter_dim, len(lanes), torch.device("cpu"), len(LABELS))
    for place, lane in enumerate(lanes):
        replay.add(place, make_rows(lane))
    return replay


def draw_shares(update):
    """Rows of each lane's half of a batch, numbered within the lane, (lane, batch / 2, time + 1)."""
    rng = np.random.default_rng(100 + update)
    starts = rng.integers(0, 5, (LANES, BATCH // LANES)) * 12 + rng.integers(0, 7, (LANES, BATCH // LANES))
    return torch.as_tensor(starts[..., None] + np.arange(LENGTH + 1))


def learn(kind, ranks, updates):
    """The losses of every update, and what the learner holds afterwards; one update is spoilt for the last rank."""
    lanes = [ranks.rank] if ranks.size > 1 else [*range(LANES)]
    replay = make_replay(lanes)
    torch.manual_seed(0)
    model = WorldModel(TINY.model, 1, LABELS)
    model = accelerate(model) if kind == "fast" else model
    model.backend.trunk_dtype = torch.float32
    config = replace(TINY.learning, turned_share=0.3, random_shift=2, **CALM)
    learner = Standalone(model, config, 0.9, replay, seed=0, ranks=ranks)
    history = []
    for update in range(updates):
        shares = draw_shares(update)
        rows = torch.cat([shares[lane] + place * LANE_ROWS for place, lane in enumerate(lanes)])
        batch = replay.gather(rows)
        if update == SPOILT and LANES - 1 in lanes:
            batch.rewards[-1] = torch.nan
        learner.training_step(batch, update)
        learner.catch_up()
        history.append({name: float(value) for name, value in learner.metrics.items()})
    learner.teardown("fit")
    state = {name: value.double().sum().item() for name, value in learner.state_dict().items()}
    return {"losses": history, "state": state}


def main(updates, path):
    torch.set_num_threads(1)
    ranks = join_ranks(place_ranks(TINY))
    found = {kind: learn(kind, ranks, updates) for kind in ("plain", "fast")}
    kernels = find_kernels(torch.float32)
    factors = "torch" if kernels is None else str(kernels.half)
    path.write_text(json.dumps(found | {"size": ranks.size, "factors": factors}))
    ranks.together(lambda: None)
    ranks.close()


if __name__ == "__main__":
    main(int(sys.argv[1]), Path(sys.argv[2]))
