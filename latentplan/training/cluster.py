"""A Ray cluster, which Ray starts on this machine or which runs already; Ray is imported when it is asked for."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from typing import Any

from latentplan.config import UserError
from latentplan.config.checks import shown
from latentplan.config.estimates import count_cores
from latentplan.config.extras import import_extra
from latentplan.config.variables import environment_variables

PROBE_SECONDS = 5.0  # for the address of a cluster to answer


def join_cluster(address: str | None, workers: int = 0, log_to_driver: bool = True) -> Any:
    """The module `ray`, connected to a cluster.

    Args:
        address: Address of the cluster as HOST:PORT; None starts Ray on this machine alone.
        workers: Workers that the cluster must have cores for.
        log_to_driver: Whether this process prints what the workers print.

    Raises:
        UserError: Ray is not installed, nobody answers at the address, or the cluster has fewer cores than workers.
    """
    ray = import_extra("ray", "a Ray cluster")
    if not ray.is_initialized():
        if address is not None:
            _probe(address)
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        more: dict[str, Any] = {"log_to_driver": log_to_driver}
        if address is None:
            more |= {"include_dashboard": False, "num_cpus": max(workers, count_cores())}
        with _own_sigterm(), environment_variables(_cluster_variables()):
            try:
                ray.init(address=address or "local", logging_level="ERROR", **more)
            except (ConnectionError, RuntimeError, ValueError) as error:
                reason = (str(error).splitlines() or [type(error).__name__])[0]
                token = (
                    ""
                    if address is None
                    else "; if it has a token, RAY_AUTH_MODE and RAY_AUTH_TOKEN must be set here too"
                )
                raise UserError(
                    f"cannot join the Ray cluster {address or 'of this machine'}: {reason}{token}"
                ) from None
    cores = int(ray.cluster_resources().get("CPU", 0))
    if address is not None and cores < workers:
        raise UserError(f"the Ray cluster has {cores} cores, too few for {workers} workers or runs side by side")
    return ray


def _probe(address: str) -> None:
    """Refuses an address at which nobody answers, because Ray itself would wait for minutes."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal():
        raise UserError(f"the address of a Ray cluster must be HOST:PORT, got {shown(address)}")
    try:
        socket.create_connection((host, int(port)), timeout=PROBE_SECONDS).close()
    except (OSError, OverflowError) as error:
        raise UserError(f"no Ray cluster answers at {address}: {error}; start one with: ray start --head") from None


@contextlib.contextmanager
def _own_sigterm() -> Iterator[None]:
    """Keeps this process's handler of SIGTERM, which `ray.init` replaces."""
    handler = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, handler)


def _cluster_variables() -> dict[str, str]:
    """Variables of a cluster that starts meanwhile.

    Its workers find the modules of this process, as those of `multiprocessing` do, and what they have started may save
    itself when they end.
    """
    modules = os.pathsep.join(os.path.abspath(folder) for folder in sys.path)
    return {"PYTHONPATH": modules, "RAY_kill_child_processes_on_worker_exit": "false"}
