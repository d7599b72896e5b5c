"""Boxes are recognised in expressions, and the degree of a box equals the value of its expression."""

import math

import pytest
import torch

from latentplan.objectives.box import box_degree, box_of, planning_degree
from latentplan.objectives.expression import evaluate
from latentplan.objectives.parser import parse_objective

SCALES = {"height": 0.6, "speed": 1.0, "upright": 0.5, "task.walk": 0.5}
QUANTITIES = ("height", "speed", "upright")
INF = math.inf


def box(text):
    return box_of(parse_objective(text, SCALES), QUANTITIES)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("height > 1.2", {"height": (1.2, INF)}),
        ("speed < -0.5", {"speed": (-INF, -0.5)}),
        ("speed -> 2.0 and height > 1.1", {"speed": (2.0, 2.0), "height": (1.1, INF)}),
        ("abs(speed) < 0.2 and height > 1.2", {"speed": (-0.2, 0.2), "height": (1.2, INF)}),
        ("abs(speed) -> 0", {"speed": (0.0, 0.0)}),
        ("1.2 < height", {"height": (1.2, INF)}),
        ("speed > -0.5 and 0.5 > speed", {"speed": (-0.5, 0.5)}),
        ("0.5 * (height > 1.2 and upright > 0.9)", {"height": (1.2, INF), "upright": (0.9, INF)}),
    ],
)
def test_box_of_returns_the_intervals_of_an_expression(text, expected):
    assert box(text) == expected
    low, high = (torch.tensor([expected.get(name, (-INF, INF))[end] for name in QUANTITIES]) for end in (0, 1))
    values = 3.0 * torch.randn(200, 3, generator=torch.Generator().manual_seed(0))
    [(weight, node)] = parse_objective(text, SCALES).terms
    expected_degree = evaluate(node, lambda name: values[:, QUANTITIES.index(name)], planning_degree)
    degree = box_degree(low, high, values, torch.tensor([SCALES[name] for name in QUANTITIES]))
    assert weight > 0.0 and torch.allclose(degree, expected_degree, atol=1e-6)


@pytest.mark.parametrize(
    "text",
    [
        "speed",
        "return",
        "task(walk)",
        "task(walk) > 0.5",
        "abs(speed) > 1.0",
        "abs(speed) -> 1.0",
        "abs(speed) < -1.0",
        "speed > height",
        "2 * speed > 1.0",
        "speed > 1.0 and speed < 0.5",
        "(speed -> 1.0) + (height > 1.2)",
        "-1 * (speed -> 1.0)",
        "return + 2 * (speed -> 1.0)",
    ],
)
def test_box_of_returns_none_when_expression_is_not_a_box(text):
    assert box(text) is None


def test_box_degree_is_one_when_every_interval_is_open():
    values = torch.randn(5, 3)
    assert torch.equal(box_degree(torch.full((3,), -INF), torch.full((3,), INF), values, torch.ones(3)), torch.ones(5))
