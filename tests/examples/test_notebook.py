"""The notebook runs from the first cell to the last, as a kernel runs it, and is stored without results.

Its cells are plain Python, so that they run here in one namespace, without the packages of a notebook's kernel.
"""

import ast
import json
import re
import time

import matplotlib
import numpy as np
import pytest

MOST_CELLS = 15
SECONDS = 120.0  # of processors: a minute on two cores


@pytest.fixture(scope="module")
def notebook(root):
    return json.loads((root / "examples" / "tour.ipynb").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def cells(notebook):
    """The code of each cell, by the cell's identifier."""
    return {cell["id"]: "".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"}


@pytest.fixture(scope="module")
def played(cells, root):
    """What the cells print, the pictures that they show, their variables, and the processor's seconds."""
    import contextlib
    import io
    import os

    import matplotlib.pyplot as plt

    printed, shown, namespace, started = io.StringIO(), [], {"__name__": "__main__"}, time.process_time()

    def show():
        for number in plt.get_fignums():
            canvas = plt.figure(number).canvas
            canvas.draw()
            shown.append(np.asarray(canvas.buffer_rgba()))
        plt.close("all")

    before, real_show = os.getcwd(), plt.show
    matplotlib.use("agg")
    plt.show = show
    os.chdir(root / "examples")  # where Jupyter starts the kernel
    try:
        with contextlib.redirect_stdout(printed):
            for name, code in cells.items():
                exec(compile(code, f"cell {name}", "exec"), namespace)
    finally:
        os.chdir(before)
        plt.show = real_show
    return printed.getvalue(), shown, namespace, time.process_time() - started


def test_notebook_is_short_plain_python_without_stored_results(notebook, cells):
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    identifiers = [cell["id"] for cell in notebook["cells"]]
    assert len(identifiers) < MOST_CELLS and len(set(identifiers)) == len(identifiers)
    assert all(re.fullmatch(r"[a-zA-Z0-9_-]{1,64}", name) for name in identifiers)
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == [] and cell["execution_count"] is None
    for name, code in cells.items():
        ast.parse(code, f"cell {name}")  # a magic or a shell command would need a kernel


def test_notebook_names_pages_that_exist(notebook, root):
    texts = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "markdown"]
    pages = re.findall(r"`((?:docs|examples)/[\w./-]*)`", "\n".join(texts))
    assert len(pages) >= 4 and all((root / page).exists() for page in pages)


def test_notebook_plans_swings_the_pole_up_and_reaches_the_new_goal(played):
    printed, _, namespace, seconds = played
    assert seconds < SECONDS
    plan = namespace["plan"]
    assert float(plan.actions[0, 0, 0]) == pytest.approx(float(namespace["action"][0]))
    number = r"(-?[\d.]+)"
    (task, goal) = re.findall(rf"^(?:task|goal): cart {number} m, upright {number}$", printed, re.MULTILINE)
    assert float(re.search(rf"^return {number} of at most 1000$", printed, re.MULTILINE)[1]) > 700
    assert abs(float(task[0])) < 0.3 and float(task[1]) > 0.9
    assert abs(float(goal[0]) - 0.8) < 0.15 and float(goal[1]) < -0.9


def test_notebook_shows_a_plan_two_films_and_a_plot(played):
    _, shown, _, _ = played
    assert len(shown) == 4
    assert all(picture.shape[0] >= 200 and picture.shape[1] >= 400 and picture.std() > 10.0 for picture in shown)
