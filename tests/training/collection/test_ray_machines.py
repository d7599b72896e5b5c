"""A Ray cluster of two machines, each a network namespace with processes and a network of its own; needs root."""

import os
import secrets
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.training.run_folder import read_epochs, read_rows

ADDRESSES = {"latentplan-a": "10.231.7.1", "latentplan-b": "10.231.7.2"}
HEAD, OTHER = ADDRESSES
PORT = 6379
PATIENCE = 240.0
ROOT = Path(__file__).parents[3]
TOKEN = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
ENVIRONMENT = os.environ | TOKEN | {"PYTHONPATH": str(ROOT), "RAY_USAGE_STATS_ENABLED": "0"}


def can_make_namespaces():
    if shutil.which("ip") is None or os.geteuid() != 0:
        return False
    made = subprocess.run(["ip", "netns", "add", HEAD], capture_output=True).returncode == 0
    subprocess.run(["ip", "netns", "del", HEAD], capture_output=True)
    return made


pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(find_spec("ray") is None, reason="needs latentplan[ray]"),
]


def on(machine, *command, **options):
    """Starts a command on a machine."""
    words = ["ip", "netns", "exec", machine, *map(str, command)]
    return subprocess.Popen(words, start_new_session=True, **options)


def start_ray(machine, *flags, **options):
    ray = Path(sys.executable).with_name("ray")
    address = ADDRESSES[machine]
    return on(machine, ray, "start", *flags, "--node-ip-address", address, "--num-cpus", 4, "--block", **options)


def end(machine):
    """Ends everything that runs on a machine, as if its power failed."""
    found = subprocess.run(["ip", "netns", "pids", machine], capture_output=True, text=True).stdout.split()
    for process in found:
        with suppress(ProcessLookupError):
            os.kill(int(process), signal.SIGKILL)
    return len(found)


def wait_for(happened, process):
    started = time.monotonic()
    while not happened():
        assert process.poll() is None, "the process ended"
        assert time.monotonic() - started < PATIENCE, "nothing happened"
        time.sleep(0.5)


@pytest.fixture
def machines(tmp_path):
    """Two machines with a cable between them, and Ray on both; logs are in the test's folder."""

    def run(*words):
        subprocess.run(["ip", *words], check=True)

    def has(text):
        return lambda: text in (tmp_path / "ray.log").read_text()

    if not can_make_namespaces():
        pytest.skip("needs the right to make network namespaces")
    try:
        run("link", "add", "lp-a", "type", "veth", "peer", "name", "lp-b")
        for (machine, address), end_of_cable in zip(ADDRESSES.items(), ("lp-a", "lp-b"), strict=True):
            run("netns", "add", machine)
            run("link", "set", end_of_cable, "netns", machine)
            for words in (f"addr add {address}/24 dev {end_of_cable}", f"link set {end_of_cable} up", "link set lo up"):
                run("-n", machine, *words.split())
        with (tmp_path / "ray.log").open("w") as log:
            options = {"stdout": log, "stderr": log, "env": ENVIRONMENT}
            head = start_ray(HEAD, "--head", "--port", PORT, "--include-dashboard", "false", **options)
            wait_for(has("Ray runtime started"), head)
            other = start_ray(OTHER, "--address", f"{ADDRESSES[HEAD]}:{PORT}", **options)
            wait_for(lambda: (tmp_path / "ray.log").read_text().count("Ray runtime started") == 2, other)
        yield
    finally:
        for machine in ADDRESSES:
            end(machine)
            subprocess.run(["ip", "netns", "del", machine], capture_output=True)
        subprocess.run(["ip", "link", "del", "lp-a"], capture_output=True)  # where it has not moved to a machine


def train(folder, environment):
    """Starts a run on the first machine that collects on both."""
    settings = (
        "--domain cartpole --env.render_quality fastest --frames 12000 --device cpu --run.threads 1 "
        f"--run-dir {folder} --collection.backend ray --collection.workers 4 "
        f"--run.ray-address {ADDRESSES[HEAD]}:{PORT} --collection.behaviour actor "
        "--collection.round_decisions 200 --collection.updates_per_decision 0.02 "
        "--evaluation.episodes 1 --evaluation.final_episodes 1 --evaluation.video false --evaluation.report false"
    )
    with Path(f"{folder}.log").open("w") as log:
        command = [sys.executable, ROOT / "scripts" / "train.py", *settings.split()]
        return on(HEAD, *command, stdout=log, stderr=log, cwd=ROOT, env=environment)


def test_run_goes_on_when_a_machine_is_lost(machines, tmp_path):
    folder = tmp_path / "run"
    run = train(folder, ENVIRONMENT)
    wait_for(lambda: (folder / "metrics.csv").exists() and len(read_epochs(folder)) >= 2, run)
    assert end(OTHER) > 4  # Ray itself, and actors
    assert run.wait(PATIENCE) == 0
    rows = read_rows(folder)
    assert int(rows[-1]["env_frames"]) >= 12000
    restarts = [int(row["env_restarts"]) for row in rows if row["env_restarts"]]
    assert 1 <= max(restarts) <= 4, "only the workers of the machine that was lost start again"


def test_run_without_the_token_of_the_cluster_is_refused_in_one_line(machines, tmp_path):
    run = train(tmp_path / "run", ENVIRONMENT | {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)})
    assert run.wait(PATIENCE) == 2
    last = (tmp_path / "run.log").read_text().splitlines()[-1]
    assert "cannot join the Ray cluster" in last and "RAY_AUTH_TOKEN" in last
