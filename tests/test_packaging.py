"""Packaging: pins, version ranges, entry points, make targets and the script of continuous integration."""

import ast
import re
import subprocess
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
REQUIREMENTS = [
    Requirement(text)
    for text in PROJECT["project"]["dependencies"] + PROJECT["project"]["optional-dependencies"]["dev"]
]


@pytest.fixture(scope="module")
def pins():
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    return {canonicalize_name(line.split("==")[0]): Version(line.split("==")[1]) for line in lines}


def test_constraints_pin_without_local_suffixes(pins):
    assert all(version.local is None for version in pins.values())


@pytest.mark.parametrize("requirement", REQUIREMENTS, ids=str)
def test_every_dependency_is_pinned_inside_its_range(requirement, pins):
    assert pins[canonicalize_name(requirement.name)] in requirement.specifier


@pytest.mark.parametrize("name", ["torch", "mujoco", "dm-control", "lightning"])
def test_versions_known_to_break_lie_outside_the_ranges(name):
    broken = {"torch": "2.9.1", "mujoco": "4.0.0", "dm-control": "1.1.0", "lightning": "2.6.3"}
    works = {"torch": "2.11.0", "mujoco": "3.17.0", "dm-control": "1.0.50", "lightning": "2.6.6"}
    requirement = next(item for item in REQUIREMENTS if item.name == name)
    assert broken[name] not in requirement.specifier
    assert works[name] in requirement.specifier


def test_python_3_13_gets_every_requirement_of_dm_control_but_labmaze():
    environment = {"python_version": "3.13", "extra": ""}
    listed = {
        canonicalize_name(item.name) for item in REQUIREMENTS if not item.marker or item.marker.evaluate(environment)
    }
    wanted = [Requirement(text) for text in metadata.requires("dm-control")]
    needed = {canonicalize_name(item.name) for item in wanted if not item.marker or item.marker.evaluate(environment)}
    assert needed - listed == {"labmaze"}
    assert "dm-control" not in listed


def test_every_subpackage_is_packaged():
    listed = set(PROJECT["tool"]["setuptools"]["packages"])
    found = {".".join(path.relative_to(ROOT).parent.parts) for path in (ROOT / "latentplan").rglob("*.py")}
    assert {"latentplan", "latentplan.configs", *found} == listed


def test_package_ships_the_marker_of_typed_packages():
    assert (ROOT / "latentplan" / "py.typed").is_file()


def test_console_script_exists():
    module, function = PROJECT["project"]["scripts"]["latentplan"].split(":")
    tree = ast.parse((ROOT / (module.replace(".", "/") + ".py")).read_text())
    assert function in [node.name for node in tree.body if isinstance(node, ast.FunctionDef)]


@pytest.mark.parametrize("target", ["setup", "train", "test", "test-all", "check", "doctor", "bench", "soak", "docs"])
def test_make_has_target(target):
    result = subprocess.run(["make", "-n", target], cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


def test_arguments_of_make_follow_the_default_domain():
    command = ["make", "-n", "train", "ARGS=--domain cartpole --minutes 5"]
    output = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert "scripts/train.py --domain walker --domain cartpole --minutes 5" in output


def test_continuous_integration_checks_builds_and_trains_only():
    path = ROOT / ".ci" / "run"
    assert path.stat().st_mode & 0o100
    script = path.read_text().replace("\\\n", " ")
    commands = [line.split()[0:2] for line in script.splitlines() if line and not line.startswith("#")]
    assert commands[:2] == [["set", "-euo"], ["cd", commands[1][1]]]
    assert commands[2:] == [["make", "check"], ["make", "docs"], ["make", "train"]]


def test_flags_of_continuous_integration_are_valid():
    from latentplan.commands import train
    from latentplan.commands.flags import read_request

    script = (ROOT / ".ci" / "run").read_text().replace("\\\n", " ")
    arguments = re.search(r'ARGS="([^"]*)"', script)[1].split()
    request = read_request(train.Request, ["--domain", "walker", *arguments])
    assert train.resolve(request).env.domain == "cartpole"
