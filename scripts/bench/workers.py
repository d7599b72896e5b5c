"""Jobs of a benchmark in processes of their own, with results in the order of the jobs."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

Job = TypeVar("Job")
Result = TypeVar("Result")


def run_in_order(function: Callable[[Job], Result], jobs: Sequence[Job], workers: int) -> Iterator[Result]:
    """Yields the result of each job in order, as soon as this job and all jobs before it are finished.

    Args:
        function: Computes the result of a job; picklable if there are several workers.
        jobs: The jobs.
        workers: Jobs that run at once, each in a process that begins with one thread; 1 runs them in this process.
    """
    if workers == 1:
        yield from map(function, jobs)
        return
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor

    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(min(workers, len(jobs)), context, _limit_threads)
    try:
        for future in [pool.submit(function, job) for job in jobs]:
            yield future.result()
    except BaseException:  # an interruption too: no further job begins, and those that run are given up
        pool.shutdown(wait=False, cancel_futures=True)
        for process in multiprocessing.active_children():
            process.terminate()
        raise
    pool.shutdown()


def _limit_threads() -> None:
    """Limits a new process to one thread, before torch and the renderer are imported."""
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
