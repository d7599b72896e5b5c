"""The files of `deploy/`: what they name exists, and they parse."""

import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

from latentplan.commands.flags import list_flags
from latentplan.commands.train import Request

ROOT = Path(__file__).resolve().parent.parent
DEPLOY = ROOT / "deploy"
FLAG = re.compile(r"--(?:collection|run)\.[\w-]+")


def instructions():
    """The instructions of the Dockerfile, as (name, words)."""
    text = re.sub(r"\\\n\s*", "", (DEPLOY / "Dockerfile").read_text())
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    return [(line.split()[0], line.partition(" ")[2]) for line in lines]


def test_dockerfile_copies_what_exists_and_has_a_base_that_can_be_chosen():
    found = instructions()
    assert found[:2] == [("ARG", "BASE=debian:bookworm-slim"), ("FROM", "${BASE}")]
    sources = [word for name, words in found if name in ("COPY", "ADD") for word in words.split()[:-1]]
    assert sources and all((ROOT / source).exists() for source in sources)
    assert {name for name, _ in found} <= {"ARG", "FROM", "ENV", "RUN", "WORKDIR", "COPY", "CMD"}
    assert ("CMD", '["make", "train"]') in found


def test_dockerfile_installs_the_libraries_that_make_setup_looks_for():
    install = next(words for name, words in instructions() if "apt-get install" in words)
    pairs = re.search(r"for pair in (.*); do", (ROOT / "Makefile").read_text()).group(1)
    assert {pair.split(":")[1] for pair in pairs.split()} <= set(shlex.split(install))


def test_compose_file_starts_a_head_and_two_workers_of_one_image():
    compose = yaml.safe_load((DEPLOY / "compose.yaml").read_text())
    head, worker = (compose["services"][name] for name in ("head", "worker"))
    assert (DEPLOY / head["build"]["context"] / head["build"]["dockerfile"]).resolve() == DEPLOY / "Dockerfile"
    assert head["image"] == worker["image"] and head["volumes"] == worker["volumes"]
    assert worker["deploy"]["replicas"] == 2 and worker["depends_on"] == {"head": {"condition": "service_healthy"}}
    port = re.search(r"--port=(\d+)", head["command"]).group(1)
    assert f"--address=head:{port}" in worker["command"]
    assert {volume.split(":")[0] for volume in head["volumes"]} == set(compose["volumes"])


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_slurm_script_parses():
    done = subprocess.run(["bash", "-n", str(DEPLOY / "slurm.sh")], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("name", ["compose.yaml", "slurm.sh"])
def test_flags_in_examples_exist(name):
    known = {spelling for flag in list_flags(Request) for spelling in flag.names}
    found = set(FLAG.findall((DEPLOY / name).read_text()))
    assert found and found <= known
