"""The trainer of `benchmark.py faults`: starts a toy run, or continues it if it was saved before.

Usage: python -m bench.faults_trainer FOLDER FRAMES TRIGGERS
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import torch

from bench.toy import FaultyDot, take, toy_config
from latentplan.commands.shell import run_guarded
from latentplan.config import ReplayConfig

SAVE_MINUTES = 0.25
MAX_RESTARTS = 10**6  # environments fail as long as the run is disturbed
CAPACITY = 2000  # so that rows are overwritten and the disk stays small


def main(folder: Path, frames: int, triggers: Path) -> int:
    """Trains or resumes, and returns the exit code."""
    from latentplan.replay.buffer import Batch
    from latentplan.training import resume, saving, train
    from latentplan.training.learner.curriculum import Curriculum

    saving.SAVE_MINUTES = SAVE_MINUTES
    unchanged = Curriculum.__call__

    def poison(curriculum: Curriculum, batch: Batch) -> Batch:
        batch = unchanged(curriculum, batch)
        return batch._replace(rewards=batch.rewards * torch.nan) if take(triggers / "nan") else batch

    Curriculum.__call__ = poison  # type: ignore[method-assign,assignment]
    make_env = FaultyDot(triggers)
    if (folder / "config.yaml").exists():
        return resume(folder, frames=frames, make_env=make_env).exit_code
    config = toy_config(folder, frames, overlap=True)
    collection = replace(config.collection, max_restarts=MAX_RESTARTS)
    return train(replace(config, collection=collection, replay=ReplayConfig(capacity=CAPACITY)), make_env).exit_code


if __name__ == "__main__":
    torch.set_num_threads(1)
    sys.exit(run_guarded(lambda words: main(Path(words[0]), int(words[1]), Path(words[2])), sys.argv[1:]))
