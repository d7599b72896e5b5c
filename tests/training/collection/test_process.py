"""Workers return results in the order of requests, from this process and from another process."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest

import latentplan
from latentplan.config import EnvironmentFault, UserError
from latentplan.training.collection.process import LocalWorker, RemoteWorker
from tests.envs.test_endings import Plain, count


def test_collection_process_imports_no_lightning(run_python):
    script = "import sys, latentplan.training.collection.process; print('lightning' in sys.modules)"
    assert run_python("-c", script).stdout.strip() == "False"


def test_local_worker_returns_results_in_the_order_of_requests(tiny, dot):
    worker = LocalWorker(tiny(""), dot, "cpu")
    worker.submit("describe")
    worker.submit("collect", None, "random", 3, 0)
    worker.submit("collect", None, "random", 5, 1)
    assert worker.result().action_dim == 1
    assert [worker.result().decisions for _ in range(2)] == [3, 5]
    worker.close()


def test_remote_worker_collects_in_several_environments_and_ends_its_process(tiny, dot, capfd):
    config = tiny("", env={"num_envs": 2})
    worker = RemoteWorker(config, dot)
    worker.submit("collect", None, "random", 44, 0)
    collected = worker.result()
    process = worker._process
    worker.close()
    assert collected.decisions == 44 and len(collected.rows) == 2
    assert all(np.flatnonzero(rows.is_first).tolist() == [0, 21] for rows in collected.rows)
    assert not np.array_equal(collected.rows[0].frames, collected.rows[1].frames)
    assert not process.is_alive()
    assert "Traceback" not in capfd.readouterr().err


def test_environments_are_closed_when_their_collection_process_ends(tiny, tmp_path):
    worker = RemoteWorker(tiny(""), partial(Plain, "", tmp_path))
    worker.submit("describe")
    worker.result()
    worker.close()
    assert count(tmp_path, "made") == count(tmp_path, "closed") > 0


def test_remote_worker_raises_user_errors_and_failures_of_the_collector(tiny, dot):
    class Failing(dot):
        def step(self, action):
            raise ZeroDivisionError("the dot is lost")

    no_environments = [{}]
    worker = RemoteWorker(tiny(""), lambda: no_environments.pop() if no_environments else Failing())
    worker.submit("describe")
    with pytest.raises(UserError, match=r"must return a gymnasium\.Env, got dict"):
        worker.result()
    worker.submit("evaluate", 1)
    with pytest.raises(EnvironmentFault, match=r"raised ZeroDivisionError: the dot is lost after 10 restarts") as fault:
        worker.result()
    assert fault.value.origin.rstrip().endswith("ZeroDivisionError: the dot is lost")
    package = str(Path(latentplan.__file__).parent)  # not the name alone, which the folder above may have as well
    assert package not in fault.value.origin and 'raise ZeroDivisionError("the dot is lost")' in fault.value.origin
    worker.close()


def test_remote_worker_raises_when_its_process_has_died(tiny, dot):
    worker = RemoteWorker(tiny(""), dot)
    worker._process.kill()
    worker.submit("describe")
    with pytest.raises(RuntimeError, match="ended unexpectedly"):
        worker.result()
    worker.close()
