"""The examples of docs/guides/planning.md run, and its table lists every option."""

import dataclasses
import re
from pathlib import Path

import pytest

from latentplan.planning import CEMPlanner

PAGE = (Path(__file__).parents[2] / "docs" / "guides" / "planning.md").read_text()
EXAMPLES = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)


def test_planning_page_has_five_examples():
    assert len(EXAMPLES) == 5


@pytest.mark.parametrize("index", range(len(EXAMPLES)))
def test_planning_page_example_runs(index):
    exec(compile(EXAMPLES[index], f"docs/guides/planning.md, example {index}", "exec"), {"__name__": "example"})


def test_planning_page_lists_every_option_with_its_default():
    rows = [
        line.split("|") for line in PAGE.split("## Options")[1].split("## ")[0].splitlines() if line.startswith("| `")
    ]
    documented = {}
    for _, names, defaults, _, _ in rows:
        names = re.findall(r"`(\w+)`", names)
        values = [value.strip() for value in defaults.split(",")]
        documented |= dict(zip(names, values if len(values) == len(names) else ["", ""], strict=True))
    fields = {field.name: field.default for field in dataclasses.fields(CEMPlanner)}
    assert documented.keys() == fields.keys()
    for name, default in fields.items():
        if default is not dataclasses.MISSING:
            shown = documented[name]
            assert shown == str(default) or float(shown) == float(default), name
