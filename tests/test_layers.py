"""Who may import whom, how long files and functions may be, and what importing must not do."""

import ast
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "latentplan"

# layer: (layers of latentplan it may import, libraries it may import); None allows anything.
ALL = (
    "config",
    "planning",
    "models",
    "envs",
    "replay",
    "reporting",
    "goals",
    "scoring",
    "agent",
    "background",
    "gate",
    "rollout",
    "checkpoint",
)
SIMULATION = {"dm_control", "dm_env", "mujoco", "gymnasium", "OpenGL"}
LAYERS = {
    "config": ((), set()),
    "planning": (("config",), {"torch", "einops"}),
    "goals": (("config", "planning"), {"torch", "einops", "numpy", "cv2"}),
    "models": (("config",), {"torch", "einops"}),
    "envs": (("config", "goals"), {*SIMULATION, "numpy", "cv2"}),
    "memory": (("config",), {"torch"}),
    "replay": (("config", "memory"), {"numpy", "torch", "einops"}),
    "reporting": (("config",), {"numpy", "cv2", "matplotlib", "rich"}),
    "random_agent": ((), {"numpy"}),
    "agent": (("config", "models", "planning", "goals", "random_agent"), {"torch", "numpy", "einops"}),
    "scoring": (("config", "envs", "goals"), {"numpy", "gymnasium"}),
    "background": (("config", "models", "planning", "goals", "agent"), {"torch", "numpy"}),
    "gate": (("config", "models", "planning", "goals", "agent"), {"torch", "numpy"}),
    "rollout": (("config", "envs", "replay", "agent"), {"numpy"}),
    "latency": (("config",), {"numpy"}),
    "virtual_clock": (("config", "planning", "latency", "rollout"), {"numpy", "torch"}),
    "checkpoint": (
        ("config", "models", "planning", "agent", "background", "gate"),
        {"torch", "numpy", "safetensors"},
    ),
    "timed_rollout": (
        ("config", "agent", "background", "rollout", "checkpoint", "virtual_clock"),
        {"numpy"},
    ),
    "export": (("config", "models", "agent", "checkpoint"), {"torch"}),
    "training": (
        (*ALL, "compose"),
        {"lightning", "torch", "numpy", "einops", "rich", "tensorboard", "gymnasium", "yaml"},
    ),
    "compose": (("config",), {"jsonargparse", "yaml"}),
    "setting_flags": (("config", "compose"), set()),
    "cli": None,
    "doctor": None,
    "evaluate": None,
    "evaluation_request": None,
    "distill": None,
    "learn_goals": None,
    "__init__": None,
    "__main__": None,
}
EAGER = {"config", "compose", "cli", "jsonargparse", "rich"}  # what the command line may import before it is used
IGNORED = {".git", ".venv", "runs", "build", "dist", "__pycache__"}
MACHINE_PATHS = re.compile(r"(?<![\w.])/(?:work|opt|root|home|mnt|data|Users)/|\.\./shared")


def files_under(folder, *suffixes):
    paths = (path for path in folder.rglob("*") if path.is_file() and not IGNORED & set(path.relative_to(ROOT).parts))
    return sorted(path for path in paths if not suffixes or path.suffix in suffixes)


def layer_of(path):
    """The layer a file belongs to: the first name below the package."""
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def type_checking_lines(tree):
    """Lines that only type checkers read."""
    lines = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            lines.update(range(node.lineno, node.end_lineno + 1))
    return lines


def imports(tree):
    """Every (line, dotted module, names imported from it) of a file."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name, ()
        elif isinstance(node, ast.ImportFrom):
            yield node.lineno, "." * node.level + (node.module or ""), tuple(alias.name for alias in node.names)


def imported_layers(module, names):
    """The layers that `import module` or `from module import names` reaches."""
    parts = module.split(".")
    return parts[1:2] or [name if name in LAYERS else "__init__" for name in names or ("",)]


def violations(path, source):
    """What a file imports and may not, as `file:line: reason`."""
    layer, tree = layer_of(path), ast.parse(source)
    where, typing_only = path.relative_to(ROOT), type_checking_lines(tree)
    assert layer in LAYERS, f"{where}: {layer!r} is in no layer; add it to the table"
    if LAYERS[layer] is None:
        return []
    layers, libraries = LAYERS[layer]
    found = []
    for line, module, names in imports(tree):
        top = module.split(".")[0]
        if module.startswith("."):
            found.append(f"{where}:{line}: relative import")
        elif top == "latentplan":
            wrong = [name for name in imported_layers(module, names) if name not in (layer, *layers, "__init__")]
            found += [f"{where}:{line}: {layer} may not import latentplan.{name}" for name in wrong]
        elif top not in sys.stdlib_module_names and top not in libraries and line not in typing_only:
            found.append(f"{where}:{line}: {layer} may not import {top}")
    return found


def test_layers_import_only_what_lies_below_them():
    found = [text for path in files_under(PACKAGE, ".py") for text in violations(path, path.read_text())]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("line", "allowed"),
    [
        ("from latentplan.config import PlannerConfig", True),
        ("from latentplan.planning.model import LatentModel", True),
        ("import torch.nn.functional as F", True),
        ("import dm_control", False),
        ("from latentplan.models import WorldModel", False),
        ("from latentplan import models", False),
        ("import latentplan.envs", False),
        ("from .model import LatentModel", False),
        ("def late():\n    import lightning", False),
    ],
)
def test_the_layer_check_sees_every_way_to_import(line, allowed):
    assert (violations(PACKAGE / "planning" / "cem.py", line) == []) == allowed


def test_the_command_line_imports_libraries_only_when_used():
    for path in [PACKAGE / f"{name}.py" for name in ("__init__", "__main__", "cli", "compose")]:
        tree = ast.parse(path.read_text())
        top_level = ast.Module([node for node in tree.body if not isinstance(node, ast.If)], [])
        outer = [node for node in top_level.body if isinstance(node, ast.Import | ast.ImportFrom)]
        for line, module, names in imports(ast.Module(outer, [])):
            top = module.split(".")[0]
            reached = imported_layers(module, names) if top == "latentplan" else [top]
            for name in reached:
                standard = name in sys.stdlib_module_names or name == "__init__"
                assert standard or name in EAGER, f"{path.name}:{line}: import {module} where it is used"


def test_files_and_functions_stay_short():
    found = []
    for path in [path for folder in ("latentplan", "scripts", "tests") for path in files_under(ROOT / folder, ".py")]:
        source = path.read_text()
        where = path.relative_to(ROOT)
        if len(source.splitlines()) > 300:
            found.append(f"{where}: {len(source.splitlines())} lines, allowed are 300")
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.end_lineno - node.lineno >= 60:
                found.append(f"{where}:{node.lineno}: {node.name} is longer than 60 lines")
    assert not found, "\n".join(found)


def test_no_file_names_a_folder_of_one_machine():
    texts = [*files_under(ROOT, ".py", ".md", ".yaml", ".yml", ".toml", ".txt", ".json", ".csv", ".html")]
    texts += [path for path in (ROOT / "Makefile", ROOT / ".ci" / "run", ROOT / ".gitignore") if path.exists()]
    found = []
    for path in texts:
        if path.name == Path(__file__).name:
            continue
        for number, line in enumerate(path.read_text().splitlines(), start=1):
            if MACHINE_PATHS.search(line):
                found.append(f"{path.relative_to(ROOT)}:{number}: {line.strip()[:100]}")
    assert not found, "\n".join(found)


def test_importing_latentplan_does_no_work(run_python):
    code = "import sys, latentplan; print(sorted({'torch', 'numpy', 'lightning', 'dm_control'} & set(sys.modules)))"
    result = run_python("-c", code)
    assert (result.stdout.strip(), result.returncode) == ("[]", 0), result.stderr


def test_planning_imports_without_the_rest_of_the_libraries(run_python):
    code = (
        "import sys\n"
        "for name in ('dm_control', 'mujoco', 'cv2', 'gymnasium', 'lightning', 'rich', 'jsonargparse'):\n"
        "    sys.modules[name] = None\n"
        "import latentplan.planning\n"
    )
    result = run_python("-c", code)
    assert result.returncode == 0, result.stderr
