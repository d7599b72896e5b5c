"""Libraries of extras: the error that names the extra, and what works without any extra."""

import json
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from latentplan.config import UserError
from latentplan.config.extras import (
    DM_CONTROL,
    EXTRAS,
    MissingExtra,
    describe_missing,
    extra_of,
    import_extra,
    require_extra,
)

ROOT = Path(__file__).resolve().parents[2]
WITHOUT_EXTRAS = f"""
import sys
for name in {[name for names in EXTRAS.values() for name in names]}:
    sys.modules[name] = None  # as if it were not installed
"""
PACKAGES = {"cv2": "opencv-python-headless", "dm_control": "dm-control", "yaml": "pyyaml", "pygame": "pygame-ce"}


def run_without_extras(code, *arguments):
    command = [sys.executable, "-c", WITHOUT_EXTRAS + code, *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True)


def test_extras_install_the_modules_that_are_said_to_need_them():
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for extra, modules in EXTRAS.items():
        packages = {Requirement(text).name for text in listed[extra]}
        assert {PACKAGES.get(module, module).replace("_", "-") for module in modules} <= packages


def test_extra_of_a_submodule_is_that_of_its_package():
    assert extra_of("mujoco.rollout") == "train"
    assert extra_of("jax") == "jax"
    assert extra_of("torch") is None
    assert extra_of(None) is None


def test_missing_module_is_one_line_that_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "scipy", None)
    line = "statistics needs scipy, which is not installed; run: pip install 'latentplan[train]'"
    for call in (import_extra, lambda module, user: require_extra(user, "torch", module)):
        with pytest.raises(MissingExtra) as error:
            call("scipy", "statistics")
        assert str(error.value) == line
    assert issubclass(MissingExtra, UserError) and issubclass(MissingExtra, ImportError)


def test_planning_and_trained_agents_work_without_extras():
    code = """
import json
import numpy as np
import latentplan.planning
from latentplan import load_agent
agent = load_agent("checkpoints/cartpole-swingup")
actions = [agent.act(np.zeros((64, 64, 3), dtype=np.uint8)).tolist()]
agent.set_objective("upright < -0.9 and cart -> 0.8")
actions.append(agent.act(np.zeros((64, 64, 3), dtype=np.uint8)).tolist())
print(json.dumps(actions))
"""
    result = run_without_extras(code)
    assert result.returncode == 0, result.stderr
    assert all(-1.0 <= action[0] <= 1.0 for action in json.loads(result.stdout))


@pytest.mark.parametrize(
    "statement",
    [
        "from latentplan.training import train",
        "import latentplan.envs",
        "from latentplan.evaluation import evaluate_agent",
        "from latentplan.reporting.film import Film",
    ],
)
def test_part_that_needs_the_extra_names_it_when_imported(statement):
    result = run_without_extras(statement)
    assert result.stderr.splitlines()[-1].endswith("run: pip install 'latentplan[train]'")


@pytest.mark.parametrize("command", ["train --minutes 1", "eval --checkpoint checkpoints/walker-walk"])
def test_command_that_needs_the_extra_is_refused_in_one_line(command):
    code = "from latentplan.commands.main import main; sys.exit(main(sys.argv[1:]))"
    result = run_without_extras(code, *command.split())
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1 and "pip install 'latentplan[train]'" in result.stderr


@pytest.mark.parametrize(("version", "what"), [((3, 12), "'latentplan[train]'"), ((3, 13), DM_CONTROL)])
def test_missing_dm_control_has_the_remedy_of_the_python_version(monkeypatch, version, what):
    monkeypatch.setattr(sys, "version_info", version)
    assert describe_missing("dm_control.suite", "rendering").endswith(f"; run: pip install {what}")
    command = shlex.split(f"pip install {DM_CONTROL}")
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]["train"]
    assert str(Requirement(command[-1]).specifier) in {str(Requirement(text).specifier) for text in listed}


def test_rendering_without_dm_control_names_the_package_and_not_the_renderer():
    code = """
import sys
sys.modules["dm_control"] = None
from latentplan.commands.main import main
raise SystemExit(main(["eval", "--checkpoint", "checkpoints/cartpole-swingup", "--episodes", "1"]))
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 2 and "MUJOCO_GL" not in done.stderr, done.stderr
    assert "needs dm_control, which is not installed; run: pip install" in done.stderr
