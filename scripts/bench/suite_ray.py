"""Runs of `benchmark.py suite` on the machines of a Ray cluster, whose folders all machines see."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from bench.runs import TrainingRun
from bench.suite_rows import note_origin, present_origin
from latentplan.training.child_run import ChildRun
from latentplan.training.cluster import join_cluster

WAIT_S = 0.1


class RayProcess:
    """The process of a run on a machine of the cluster that has free cores, and a free GPU where the run asks for one.

    Args:
        ray: The module `ray`, connected to the cluster.
        run: The run, whose folder exists.
        jobs: Runs side by side, for the origin of the run.
    """

    def __init__(self, ray: Any, run: TrainingRun, jobs: int) -> None:
        self._ray, config, command = ray, run.resolve(), run.command()
        needs = {"num_cpus": config.run.threads or 1, "num_gpus": int(config.run.device == "cuda")}
        starter = ray.remote(Starter).options(**needs)
        self._actor = starter.remote(os.getcwd(), run.folder, command, jobs, needs["num_gpus"] > 0)
        self._answer = self._actor.poll.remote()
        self._code: int | None = None
        self._has_begun = False

    def poll(self) -> int | None:
        """The exit code; None while the process runs or waits for a machine; -9 where its machine has ended."""
        if self._code is None and self._ray.wait([self._answer], timeout=0)[0]:
            self._has_begun = True
            try:
                self._code = self._ray.get(self._answer)
            except self._ray.exceptions.RayActorError:
                self._code = -signal.SIGKILL
            if self._code is None:
                self._answer = self._actor.poll.remote()
            else:
                self._ray.kill(self._actor)
        return self._code

    def stop(self) -> None:
        """Asks the process to save the run and to end; one that still waits for a machine does not begin."""
        if self.poll() is None and self._has_begun:
            self._actor.stop.remote()
        elif self._code is None:
            self._ray.kill(self._actor)
            self._code = -signal.SIGTERM

    def wait(self) -> None:
        """Returns when the process has ended."""
        while self.poll() is None:
            time.sleep(WAIT_S)


class Starter:
    """Starts and watches the process of a run on the machine where this actor lives."""

    def __init__(self, place: str, folder: Path, command: Sequence[str], jobs: int, on_gpu: bool) -> None:
        os.chdir(place)
        note_origin(folder, present_origin(jobs, on_gpu))
        self._process = ChildRun(folder, command)

    def poll(self) -> int | None:
        """The exit code of the process."""
        return self._process.poll()

    def stop(self) -> None:
        """Asks the process to save the run and to end."""
        self._process.stop()


def make_start(address: str | None, jobs: int) -> Callable[[TrainingRun], RayProcess]:
    """A function that starts runs on a cluster.

    Args:
        address: Address of the cluster as HOST:PORT; None starts Ray on this machine.
        jobs: Runs side by side.

    Raises:
        UserError: Ray is missing, nobody answers at the address, or the cluster has fewer cores than jobs.
    """
    ray = join_cluster(address, jobs)
    return lambda run: RayProcess(ray, run, jobs)
