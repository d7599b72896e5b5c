"""Workers: the same answers in this process and in another, in order, and nothing left behind."""

import multiprocessing
import os
import signal

import numpy as np
import pytest

from latentplan.config import UserError
from latentplan.training.collection.process import LocalWorker, RemoteWorker


def test_answers_arrive_in_the_order_of_the_questions(tiny, dot):
    worker = LocalWorker(tiny(""), dot, "cpu")
    worker.submit("describe")
    worker.submit("collect", None, "random", 3, 0)
    worker.submit("collect", None, "random", 5, 1)
    assert worker.result().action_dim == 1
    assert [worker.result().decisions for _ in range(2)] == [3, 5]
    worker.close()


def test_several_environments_in_another_process_leave_nothing_behind(tiny, dot, capfd):
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


def test_an_interruption_is_not_for_the_environments(tiny, dot):
    worker = LocalWorker(tiny("", env={"num_envs": 2}), dot, "cpu")
    children = multiprocessing.active_children()
    assert len(children) == 2
    for child in children:
        os.kill(child.pid, signal.SIGINT)
    worker.submit("collect", None, "random", 6, 0)
    assert worker.result().decisions == 6
    worker.close()


def test_what_the_user_got_wrong_stays_a_user_error(tiny, dot):
    worker = RemoteWorker(tiny(""), dict)
    worker.submit("describe")
    with pytest.raises(UserError, match=r"must return a gymnasium\.Env, got dict"):
        worker.result()
    worker.close()


def test_a_dead_process_is_reported(tiny, dot):
    worker = RemoteWorker(tiny(""), dot)
    worker._process.kill()
    worker.submit("describe")
    with pytest.raises(RuntimeError, match="ended unexpectedly"):
        worker.result()
    worker.close()
