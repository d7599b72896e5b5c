"""A run in a process of its own saves itself, whoever asks it to and however its parent ends."""

import signal
import subprocess
import sys
import threading
import time

import pytest

from latentplan.training.child_run import LOG, ChildRun, last_line

RUN = """
import signal, sys, time
from latentplan.training.signals import Signals
with Signals() as signals:
    print("ready", flush=True)
    while not signals.received:
        time.sleep(0.01)
    print("saving", flush=True)
    time.sleep(1.0)
    print("saved", flush=True)
"""
PARENT = """
import os, sys, time
from pathlib import Path
from latentplan.training.child_run import ChildRun, last_line
folder = Path(sys.argv[1])
run = ChildRun(folder, [sys.executable, "-c", sys.argv[2]])
while last_line(folder) != "ready":
    time.sleep(0.01)
if sys.argv[3] == "stops":
    run.stop()
    while last_line(folder) != "saving":
        time.sleep(0.01)
os._exit(0)
"""


def test_run_can_be_started_by_any_thread(tmp_path):
    started = []
    thread = threading.Thread(
        target=lambda: started.append(ChildRun(tmp_path, [sys.executable, "-c", "print('done')"]))
    )
    thread.start()
    thread.join()
    started[0].wait()
    assert started[0].poll() in (0, -signal.SIGHUP)  # the thread has ended, perhaps before the run


def wait_for(folder, line, seconds=60.0):
    started = time.monotonic()
    while last_line(folder) != line:
        assert time.monotonic() - started < seconds, last_line(folder)
        time.sleep(0.01)


@pytest.mark.parametrize("parent", ["stops", "ends"])
def test_run_saves_itself_when_its_parent_ends_whatever_it_was_asked_before(tmp_path, parent):
    subprocess.run([sys.executable, "-c", PARENT, tmp_path, RUN, parent], check=True)
    wait_for(tmp_path, "saved")


@pytest.mark.parametrize(("second", "last"), [(signal.SIGHUP, "saved"), (signal.SIGTERM, "saving")])
def test_second_signal_ends_a_run_at_once_unless_it_is_a_hangup(tmp_path, second, last):
    run = ChildRun(tmp_path, [sys.executable, "-c", RUN])
    wait_for(tmp_path, "ready")
    run.stop()
    wait_for(tmp_path, "saving")
    run._process.send_signal(second)
    run.wait()
    assert (tmp_path / LOG).read_text().splitlines()[-1] == last


def test_hangup_and_request_to_stop_that_arrive_together_are_one(tmp_path):
    """Python handles pending signals by number: the hangup first, though it was sent last."""
    both = "{signal.SIGHUP, signal.SIGTERM}"
    waits = f"""
    signal.pthread_sigmask(signal.SIG_BLOCK, {both})
    print("ready", flush=True)
    while signal.sigpending() != {both}:
        time.sleep(0.01)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {both})
"""
    run = ChildRun(tmp_path, [sys.executable, "-c", RUN.replace('\n    print("ready", flush=True)\n', waits)])
    wait_for(tmp_path, "ready")
    run.stop()
    run._process.send_signal(signal.SIGHUP)
    run.wait()
    assert (tmp_path / LOG).read_text().splitlines()[-1] == "saved"
