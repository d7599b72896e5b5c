"""A program that trains in the dot environment, or resumes, with as many processes as it is told.

Arguments: the folder of the run, the number of processes, the budget of frames, and settings such as `learning.x=3`.
"""

import os
import signal
import sys
from dataclasses import replace
from pathlib import Path

from latentplan.training import resume, train
from tests.training.conftest import TINY
from tests.training.dot import Dot


class SignalledDot(Dot):
    """A dot of which the step of a number, in the process of a rank, sends a signal; the environment says which."""

    steps = 0

    def step(self, action):
        SignalledDot.steps += 1
        rank, number = os.environ["SIGNAL_AT"].split(":")
        if SignalledDot.steps == int(number) and os.environ.get("LOCAL_RANK", "0") == rank:
            os.kill(os.getpid(), signal.SIGTERM)
        return super().step(action)


def main(folder, devices, frames):
    make_env = SignalledDot if "SIGNAL_AT" in os.environ else Dot
    if (folder / "config.yaml").exists() and os.environ.get("FRESH") is None:
        return resume(folder, frames=frames, devices=devices, make_env=make_env)
    os.environ["FRESH"] = "1"  # the other ranks begin when the folder may exist
    run = replace(TINY.run, run_dir=str(folder), devices=devices, frames=frames)
    return train(replace(TINY, run=run), make_env)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])).exit_code)
