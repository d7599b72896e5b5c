"""The allowed imports of every room, no circular imports, limits on length, and imports without side effects."""

import ast
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "latentplan"

SIMULATION = {"dm_control", "dm_env", "mujoco", "gymnasium", "OpenGL"}
# room: (rooms it may import, libraries it may import); the standard library and the room itself are always allowed.
BELOW_AGENTS = ("config", "planning", "models", "replay", "objectives")
ROOMS = {
    "config": ((), {"yaml", "jsonargparse"}),
    "planning": (("config",), {"torch", "einops", "mujoco", "jax"}),
    "models": (("config",), {"torch", "einops"}),
    "replay": (("config",), {"numpy", "torch", "einops"}),
    "reporting": (("config",), {"numpy", "cv2", "matplotlib"}),
    "objectives": (("config", "planning", "models", "replay"), {"torch", "einops", "numpy", "cv2"}),
    "envs": (BELOW_AGENTS, {*SIMULATION, "numpy", "cv2"}),
    "agents": (BELOW_AGENTS, {"torch", "numpy", "einops", "safetensors"}),
    "evaluation": ((*BELOW_AGENTS, "envs", "agents"), {"numpy", "scipy", "torch", "gymnasium"}),
    "training": (
        (*BELOW_AGENTS, "envs", "agents", "evaluation", "reporting"),
        {"lightning", "torch", "numpy", "einops", "rich", "tensorboard", "gymnasium", "yaml", "cv2", "minari"},
    ),
    "view": (
        (*BELOW_AGENTS, "envs", "agents", "evaluation", "reporting"),
        {"numpy", "starlette", "uvicorn", "plotly"},
    ),
    "commands": (
        (*BELOW_AGENTS, "envs", "agents", "evaluation", "reporting", "training", "view"),
        {"torch", "numpy", "rich", "jsonargparse", "shtab", *SIMULATION, "cv2", "lightning"},
    ),
    "__init__": (("agents",), set()),
    "__main__": (("commands",), set()),
}
EAGER = {"config", "commands", "jsonargparse", "rich"}  # modules of the command line may import these at the top
IGNORED = {".git", ".venv", "runs", "build", "dist", "__pycache__"}
MACHINE_PATHS = re.compile(r"(?<![\w.])/(?:work|opt|root|home|mnt|data|Users)/|\.\./shared")


def files_under(folder, *suffixes):
    paths = (path for path in folder.rglob("*") if path.is_file() and not IGNORED & set(path.relative_to(ROOT).parts))
    return sorted(path for path in paths if not suffixes or path.suffix in suffixes)


def room_of(path):
    """The room a file belongs to: the first name below the package."""
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def module_of(path):
    """The dotted name of a file; that of its package for an `__init__`."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


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


def imported_rooms(module, names):
    """The rooms that `import module` or `from module import names` reaches."""
    parts = module.split(".")
    return parts[1:2] or [name if name in ROOMS else "__init__" for name in names or ("",)]


def find_violations(path, source):
    """The forbidden imports of a file, as `file:line: reason`."""
    room, tree = room_of(path), ast.parse(source)
    where, typing_only = path.relative_to(ROOT), type_checking_lines(tree)
    assert room in ROOMS, f"{where}: {room!r} is no room; add it to the table"
    rooms, libraries = ROOMS[room]
    found = []
    for line, module, names in imports(tree):
        top = module.split(".")[0]
        if module.startswith("."):
            found.append(f"{where}:{line}: relative import")
        elif top == "latentplan":
            wrong = [name for name in imported_rooms(module, names) if name not in (room, *rooms, "__init__")]
            found += [f"{where}:{line}: {room} may not import latentplan.{name}" for name in wrong]
        elif top not in sys.stdlib_module_names and top not in libraries and line not in typing_only:
            found.append(f"{where}:{line}: {room} may not import {top}")
    return found


def import_graph(sources):
    """The modules of the package that each module imports, anywhere in its file but for type checkers."""
    graph = {}
    for module, source in sources.items():
        tree = ast.parse(source)
        typing_only, found = type_checking_lines(tree), set()
        for line, imported, names in imports(tree):
            if line not in typing_only:
                found.update(f"{imported}.{name}" if f"{imported}.{name}" in sources else imported for name in names)
                found.update(() if names else (imported,))
        graph[module] = sorted(found & set(sources) - {module})
    return graph


def find_circles(graph):
    """Import circles, each as the list of its modules, the first one repeated at the end."""
    found, done = [], set()

    def visit(module, path):
        if module in path:
            found.append([*path[path.index(module) :], module])
        elif module not in done:
            for imported in graph[module]:
                visit(imported, [*path, module])
            done.add(module)

    for module in graph:
        visit(module, [])
    return found


def test_files_import_only_the_rooms_below_theirs():
    found = [text for path in files_under(PACKAGE, ".py") for text in find_violations(path, path.read_text())]
    assert not found, "\n".join(found)


def test_no_import_is_circular():
    found = find_circles(import_graph({module_of(path): path.read_text() for path in files_under(PACKAGE, ".py")}))
    assert not found, "\n".join(" -> ".join(circle) for circle in found)


def test_find_circles_finds_a_circle_through_a_late_import():
    sources = {"a": "def late():\n    from b import x", "b": "import c", "c": "from a import y", "d": "import a"}
    assert find_circles(import_graph(sources)) == [["a", "b", "c", "a"]]


def test_root_of_the_package_holds_no_module_of_a_room():
    assert {path.name for path in PACKAGE.iterdir() if path.is_file()} == {"__init__.py", "__main__.py", "py.typed"}


@pytest.mark.parametrize(
    ("line", "allowed"),
    [
        ("from latentplan.config import PlannerConfig", True),
        ("from latentplan.planning.model import Model", True),
        ("import torch.nn.functional as F", True),
        ("import dm_control", False),
        ("from latentplan.models import WorldModel", False),
        ("from latentplan import models", False),
        ("import latentplan.envs", False),
        ("from .model import Model", False),
        ("def late():\n    import lightning", False),
    ],
)
def test_find_violations_finds_every_form_of_import(line, allowed):
    assert (find_violations(PACKAGE / "planning" / "search" / "cem.py", line) == []) == allowed


def test_the_command_line_imports_libraries_only_when_used():
    paths = [PACKAGE / "__init__.py", PACKAGE / "__main__.py", *files_under(PACKAGE / "commands", ".py")]
    for path in paths:
        tree = ast.parse(path.read_text())
        top_level = ast.Module([node for node in tree.body if not isinstance(node, ast.If)], [])
        outer = [node for node in top_level.body if isinstance(node, ast.Import | ast.ImportFrom)]
        for line, module, names in imports(ast.Module(outer, [])):
            top = module.split(".")[0]
            reached = imported_rooms(module, names) if top == "latentplan" else [top]
            for name in reached:
                standard = name in sys.stdlib_module_names or name == "__init__"
                assert standard or name in EAGER, f"{path.name}:{line}: import {module} where it is used"


def test_functions_stay_under_60_lines_and_files_under_500():
    found = []
    for path in [path for folder in ("latentplan", "scripts", "tests") for path in files_under(ROOT / folder, ".py")]:
        source = path.read_text()
        where = path.relative_to(ROOT)
        if len(source.splitlines()) > 500:
            found.append(f"{where}: {len(source.splitlines())} lines, allowed are 500")
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
