"""The number of threads of processes that this process starts."""

from __future__ import annotations

from contextlib import AbstractContextManager

from latentplan.config.variables import environment_variables

_THREAD_SETTINGS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def single_threaded_children() -> AbstractContextManager[None]:
    """Limits processes that start inside the `with` block to one thread, by environment variables."""
    return environment_variables(dict.fromkeys(_THREAD_SETTINGS, "1"))
