"""`latentplan view` serves a session, refuses bad input before it computes, and ends at once with Ctrl-C."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from websockets.sync.client import connect

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def start(checkpoint):
    """A function that starts a live view; returns the process and the address that it printed."""
    started = []

    def run(*flags):
        words = ["view", "--checkpoint", str(checkpoint), "--device", "cpu", "--port", "0", *map(str, flags)]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        process = subprocess.Popen(
            [sys.executable, "-m", "latentplan", *words],
            cwd=ROOT,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        started.append(process)
        lines = [process.stdout.readline() for _ in range(2)]
        return process, lines, re.search(r"http://\S+", lines[1])[0]

    yield run
    for process in started:
        process.kill()
        process.communicate()


def messages(address, num=12):
    """The first messages that a page gets, by kind."""
    port = re.search(r":(\d+)/", address)[1]
    found = {}
    with connect(f"ws://127.0.0.1:{port}/live", origin=f"http://127.0.0.1:{port}") as socket:
        for _ in range(num):
            found |= json.loads(socket.recv(timeout=60))
    return found


def test_view_serves_the_agent_until_ctrl_c(start):
    flags = ("--objective", "return", "--planner.horizon", 2, "--mode", "gated", "--control-hz", 50)
    process, lines, address = start(*flags)
    assert lines[0].startswith("cartpole-swingup, gated on cpu, pictures by ") and "50 decisions per second" in lines[1]
    found = messages(address)
    assert found["settings"]["search"]["horizon"] == 2 and found["settings"]["objective"] == "return"
    assert found["settings"]["mode"] == "gated" and found["moment"]["period_ms"] == 20.0
    assert found["future"]["num_steps"] == 2
    began = time.monotonic()
    process.send_signal(signal.SIGINT)
    assert process.wait(60) == 130 and time.monotonic() - began < 30.0
    assert process.stderr.read() == ""


@pytest.mark.slow
def test_view_ends_by_sigterm_while_a_page_is_open(start):
    process, _, address = start()
    port = re.search(r":(\d+)/", address)[1]
    with connect(f"ws://127.0.0.1:{port}/live", origin=f"http://127.0.0.1:{port}") as socket:
        socket.recv(timeout=60)
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 143
    assert process.stderr.read() == ""


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (("--port", "65536"), ("--port", "[0, 65535]")),
        (("--port", "-1"), ("--port", "[0, 65535]")),
        (("--mode", "planer"), ("'planer'", "'planner'")),
        (("--objective", "cart -> "), ("the end",)),
        (("--objective", "speed -> 1"), ("'speed'",)),
        (("--constraint", "cart"), ("cart",)),
        (("--control-hz", "0"), ("--control-hz", "above 0")),
        (("--control-hz", "1e-12"), ("--control-hz", "[0.001, 1000000.0]")),
        (("--seed", "-1"), ("--seed", "at least 0")),
        (("--planner.num_elites", "9"), ("num_elites (9)", "num_samples (8)")),
        (("--host", "no such host", "--port", "0"), ("--host 'no such host'",)),
        (("--hst", "127.0.0.1"), ("--hst", "--host")),
    ],
)
def test_view_refuses_bad_flags_in_one_line(assert_refused, checkpoint, flags, words):
    assert_refused(["view", "--checkpoint", checkpoint, "--device", "cpu", *flags], *words)


def test_view_names_its_extra_before_torch_is_imported(checkpoint):
    code = f"""
import sys
sys.modules["starlette"] = None  # as if it were not installed
from latentplan.commands.main import main
code = main(["view", "--checkpoint", {str(checkpoint)!r}])
print(code, "torch" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout == "2 False\n"
    line = "error: the live view needs starlette, which is not installed; run: pip install 'latentplan[view]'\n"
    assert done.stderr == line
