"""Packaging: pins, version ranges, entry points, make targets and the script of continuous integration."""

import ast
import re
import shutil
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
EXTRAS = PROJECT["project"]["optional-dependencies"]
LISTED = [
    Requirement(text)
    for text in PROJECT["project"]["dependencies"]
    + [text for extra in ("train", "bench", "hub", "view", "browser", "ray", "dev") for text in EXTRAS[extra]]
]
REQUIREMENTS = [requirement for requirement in LISTED if requirement.name != "latentplan"]


@pytest.fixture(scope="module")
def pins():
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    return {canonicalize_name(line.split("==")[0]): Version(line.split("==")[1]) for line in lines}


def test_constraints_pin_without_local_suffixes(pins):
    assert all(version.local is None for version in pins.values())


@pytest.mark.parametrize("requirement", REQUIREMENTS, ids=str)
def test_every_dependency_is_pinned_inside_its_range(requirement, pins):
    assert pins[canonicalize_name(requirement.name)] in requirement.specifier


@pytest.mark.parametrize("name", ["torch", "mujoco", "dm-control", "lightning", "pandas"])
def test_versions_known_to_break_lie_outside_the_ranges(name):
    broken = {"torch": "2.9.1", "mujoco": "4.0.0", "dm-control": "1.1.0", "lightning": "2.6.3", "pandas": "3.1.1"}
    works = {"torch": "2.11.0", "mujoco": "3.17.0", "dm-control": "1.0.50", "lightning": "2.6.6", "pandas": "2.3.3"}
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


def test_development_brings_what_training_benchmarks_hub_and_live_view_need():
    assert {"latentplan[train]", "latentplan[bench]", "latentplan[hub]", "latentplan[view]"} <= set(EXTRAS["dev"])


def test_package_without_extras_needs_four_libraries():
    names = {Requirement(text).name for text in PROJECT["project"]["dependencies"]}
    assert names == {"torch", "einops", "numpy", "safetensors"}


@pytest.fixture(scope="module")
def metadata_of_builds(tmp_path_factory):
    """What an editable and a plain install require, as the build backend writes it, without an extra being asked."""
    source = tmp_path_factory.mktemp("source")
    for name in ("build_backend.py", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for name in ("latentplan", "configs"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    code = "import sys, build_backend as b; print(getattr(b, f'prepare_metadata_for_build_{sys.argv[1]}')(sys.argv[2]))"
    found = {}
    for kind in ("editable", "wheel"):
        out = tmp_path_factory.mktemp(kind)
        command = [sys.executable, "-c", code, kind, str(out)]
        done = subprocess.run(command, cwd=source, capture_output=True, text=True, check=True)
        text = (out / done.stdout.splitlines()[-1] / "METADATA").read_text()
        listed = [Requirement(line) for line in re.findall(r"^Requires-Dist: (.*)$", text, re.M)]
        environment = {"extra": "", "python_version": "3.12"}
        found[kind] = {item.name for item in listed if item.marker is None or item.marker.evaluate(environment)}
    return found


def test_editable_install_brings_what_training_needs(metadata_of_builds):
    wanted = [Requirement(text) for text in PROJECT["project"]["dependencies"] + EXTRAS["train"]]
    environment = {"python_version": "3.12"}
    assert metadata_of_builds["editable"] == {
        item.name for item in wanted if item.marker is None or item.marker.evaluate(environment)
    }


def test_plain_install_brings_what_planning_needs(metadata_of_builds):
    assert metadata_of_builds["wheel"] == {"torch", "einops", "numpy", "safetensors"}


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


TARGETS = ["setup", "train", "test", "test-all", "test-browser", "check", "doctor", "bench", "soak", "docs"]


@pytest.mark.parametrize("target", TARGETS)
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
