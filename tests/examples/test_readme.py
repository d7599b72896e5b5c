"""The README is short, and its commands and code blocks work."""

import inspect
import re
import shlex
import sys
import types

import gymnasium
import pytest

import latentplan.training
from latentplan.config import Config

COMMANDS = {"scripts/eval.py", "scripts/train.py", "scripts/benchmark.py"}


@pytest.fixture(scope="module")
def readme(root):
    return (root / "README.md").read_text()


@pytest.fixture(scope="module")
def blocks(readme):
    """The Python blocks, by the heading that they stand under."""
    sections = re.split(r"^## ", readme, flags=re.MULTILINE)
    found = {
        section.splitlines()[0]: re.findall(r"^```python\n(.*?)^```", section, re.M | re.S) for section in sections
    }
    return {heading: code[0] for heading, code in found.items() if code}


def commands(readme):
    """The words of every `python scripts/...` command, in a block or within a line."""
    found = re.findall(r"^(python scripts/.*)$|`(python scripts/[^`\n]*)`", readme, flags=re.MULTILINE)
    return [shlex.split(block or inline, comments=True)[1:] for block, inline in found]


def test_readme_has_at_most_150_lines(readme):
    assert len(readme.splitlines()) <= 150


def test_moving_picture_is_animated_and_small(root):
    from PIL import Image

    path = root / "docs" / "walker.webp"
    assert path.stat().st_size < 2_000_000
    with Image.open(path) as picture:
        picture.load()
        seconds = picture.n_frames * picture.info["duration"] / 1000
        assert picture.n_frames > 50 and 3.0 < seconds < 8.0


def test_every_agent_of_the_results_table_ships(readme, root):
    rows = re.findall(r"^\| (\w+-\w+) \| ([\d,]+) \| (\d+) \| (\d+) \|", readme, flags=re.MULTILINE)
    assert {task for task, *_ in rows} == {path.name for path in (root / "checkpoints").iterdir()}


def test_flags_of_commands_exist(readme, run_python):
    wanted = {}
    for script, *words in commands(readme):
        subcommand = [words[0]] if script.endswith("benchmark.py") else []
        flags = wanted.setdefault((script, *subcommand), set())
        flags.update(word for word in words if word.startswith("--"))
    assert {script for script, *_ in wanted} == COMMANDS
    for command, flags in wanted.items():
        result = run_python(*command, "--help")
        assert result.returncode == 0, result.stderr
        missing = [flag for flag in flags if not re.search(rf"{flag}\b", result.stdout)]
        assert not missing, (command, missing)


def test_targets_of_make_exist(readme, root):
    targets = set(re.findall(r"(?:^|`)make (\w+)", readme, flags=re.MULTILINE))
    assert {"setup", "train", "test"} <= targets
    assert targets <= set(re.findall(r"^(\w+):", (root / "Makefile").read_text(), flags=re.MULTILINE))


def test_block_of_a_trained_agent_runs(blocks, root, monkeypatch):
    monkeypatch.chdir(root)
    names = {}
    exec(blocks["Use a trained agent"], names)
    assert names["action"].shape == (1,)
    assert abs(names["action"]).max() <= 1.0


def test_block_of_an_own_model_runs(blocks):
    names = {}
    exec(blocks["Bring your own model"], names)
    assert names["action"].shape == (1, 1)
    assert names["action"].item() < 0.0  # towards the origin from the right side


def test_block_of_training_passes_the_config_and_the_environment(blocks, monkeypatch):
    calls = []
    signature = inspect.signature(latentplan.training.train)
    monkeypatch.setattr(latentplan.training, "train", lambda *given, **named: calls.append((given, named)))
    package = types.ModuleType("my_package")
    package.make_env = lambda: gymnasium.make("Pendulum-v1")
    monkeypatch.setitem(sys.modules, "my_package", package)
    exec(blocks["Train your own task"], {"__name__": "__main__"})
    ((given, named),) = calls
    arguments = signature.bind(*given, **named).arguments
    config = next(value for value in arguments.values() if isinstance(value, Config))
    assert config.run.minutes == 60
    assert arguments["make_env"] is package.make_env
