"""The search computes in its own precision, whatever precision the caller asks for the model."""

import pytest
import torch

from latentplan.planning import FunctionModel


@pytest.mark.parametrize(
    "options",
    [
        {"noise_beta": 2.0},
        {"action_spline": "linear", "num_knots": 3},
        {"action_choices": {0: 3}},
        {"action_choices": {0: 3}, "action_spline": "cubic", "num_knots": 3},
    ],
)
def test_plan_is_the_same_under_autocast(make_planner, seeded, options):
    model = FunctionModel(
        lambda state, action: state + action, lambda state, action: -(state + action - 1).square().sum(1)
    )
    planner, state = make_planner(**options), torch.zeros(2, 2)
    expected = planner.plan(model, state, generator=seeded())
    with torch.autocast("cpu", torch.bfloat16):
        found = planner.plan(model, state, generator=seeded())
    for name in ("actions", "mean", "var", "expected_return"):
        assert torch.equal(getattr(found, name), getattr(expected, name)), name
