"""A search uses the `fast_step` of a model."""

import pytest
import torch

from latentplan.planning import CEMPlanner, check_model


def test_search_uses_fast_step_except_for_gradients(seeded):
    class Model:
        def __init__(self):
            self.calls = {"step": 0, "fast_step": 0}

        def step(self, state, action, name="step"):
            self.calls[name] += 1
            return state + action, -(state + action).square().sum(dim=1)

        def fast_step(self, state, action):
            return self.step(state, action, "fast_step")

    model, plans = Model(), []
    for steps in (0, 1):
        planner = CEMPlanner(action_dim=2, horizon=3, num_samples=16, num_elites=4, gradient_steps=steps)
        plans.append(planner.plan(model, torch.ones(1, 2), generator=seeded(0)))
        assert (model.calls["step"] > 0) == (steps > 0) and model.calls["fast_step"] > 0
    assert not torch.equal(plans[0].actions, plans[1].actions)


def test_check_model_names_a_fast_step_that_disagrees_with_step():
    class Model:
        def step(self, state, action):
            return state + action, -state.square().sum(dim=1)

        def fast_step(self, state, action):
            return state - action, -state.square().sum(dim=1)

    with pytest.raises(ValueError, match=r"fast_step\(\) does not agree with step\(\)"):
        check_model(Model(), torch.ones(3, 2), action_dim=2)
