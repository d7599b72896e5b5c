"""A program that trains in the dot environment, or resumes, with as many processes as it is told.

Arguments: the folder of the run, the number of processes, and the budget of frames.
"""

import os
import sys
from dataclasses import replace
from pathlib import Path

from latentplan.commands.shell import refuse
from latentplan.config import UserError
from latentplan.training import resume, train
from latentplan.training.collection import crew
from latentplan.training.collection.collector import Collected
from latentplan.training.collection.process import PatientWorker, WorkerEnded
from tests.training.conftest import TINY
from tests.training.dot import Dot


class SignalledDot(Dot):
    """A dot that sends a signal to its process; the environment says to which rank, at which step, and which signal."""

    steps = 0

    def step(self, action):
        SignalledDot.steps += 1
        rank, step, number = os.environ["SIGNAL_AT"].split(":")
        if SignalledDot.steps == int(step) and os.environ.get("LOCAL_RANK", "0") == rank:
            os.kill(os.getpid(), int(number))
        return super().step(action)


class EndingWorker(PatientWorker):
    """A worker that ends with a round and is not replaced; the environment says on which rank, and with which round."""

    rounds = 0

    def result(self):
        value = super().result()
        rank, ends_with = map(int, os.environ["ENDS_WITH"].split(":"))
        if isinstance(value, Collected) and os.environ.get("LOCAL_RANK", "0") == str(rank):
            EndingWorker.rounds += 1
            if EndingWorker.rounds == ends_with:
                raise WorkerEnded("the collection process ended unexpectedly (exit code -9)")
        return value


def main(folder, devices, frames):
    config = TINY
    if "ENDS_WITH" in os.environ:
        crew.PatientWorker = EndingWorker
        config = replace(TINY, evaluation=replace(TINY.evaluation, every_frames=10**6))  # each saves the run
    make_env = SignalledDot if "SIGNAL_AT" in os.environ else Dot
    if (folder / "config.yaml").exists() and os.environ.get("FRESH") is None:
        return resume(folder, frames=frames, devices=devices, make_env=make_env)
    os.environ["FRESH"] = "1"  # the other ranks begin when the folder may exist
    run = replace(TINY.run, run_dir=str(folder), devices=devices, frames=frames)
    return train(replace(config, run=run), make_env)


if __name__ == "__main__":
    try:
        sys.exit(main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])).exit_code)
    except UserError as error:
        sys.exit(refuse(str(error)))
