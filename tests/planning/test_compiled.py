"""A compiled rollout gives the same plans."""

import pickle

import pytest
import torch

from latentplan.planning import CEMPlanner, FunctionModel, check_model, compile_rollout, terminal_value

# The mean is executed without a rollout of its own, so that all rollouts have one size.
PLANNER = CEMPlanner(action_dim=2, horizon=4, num_samples=32, num_elites=4, num_iterations=2, final="mean")


@pytest.fixture
def counted():
    """A backend that compiles nothing, and how many programs it was given."""
    programs = []

    def backend(program, _):
        programs.append(program)
        return program.forward

    return backend, programs


def test_compile_rollout_gives_the_same_plans(point, states, seeded, counted):
    backend, programs = counted
    model = compile_rollout(point, backend=backend)
    check_model(model, states, action_dim=2)
    own, compiled = (PLANNER.plan(each, states, generator=seeded()) for each in (point, model))
    assert programs
    torch.testing.assert_close(compiled.actions, own.actions)
    torch.testing.assert_close(compiled.expected_return, own.expected_return)


def test_compile_rollout_makes_one_program_of_all_steps(point, counted):
    backend, programs = counted
    model = compile_rollout(FunctionModel(point.dynamics, point.reward), backend=backend)
    PLANNER.plan(model, torch.ones(1, 4))
    assert len(programs) == 1


def test_compile_rollout_compiles_the_models_own_rollout(point, seeded, counted):
    def rollout(state, actions):
        rewards = -(state[:, :1] + actions.sum(dim=2).cumsum(dim=1)).square()
        return rewards, state

    backend, programs = counted
    bare = FunctionModel(point.dynamics, point.reward, rollout=rollout)
    own, compiled = (
        PLANNER.plan(each, torch.ones(1, 4), generator=seeded())
        for each in (bare, compile_rollout(bare, backend=backend))
    )
    assert len(programs) == 1
    torch.testing.assert_close(compiled.actions, own.actions)


def test_compile_rollout_keeps_the_set_of_optional_methods(point, counted):
    backend, _ = counted
    model = compile_rollout(FunctionModel(point.dynamics, point.reward), backend=backend)
    with pytest.raises(ValueError, match=r"needs a model with value\(\)"):
        PLANNER.plan(model, torch.ones(1, 4), objective=terminal_value())


class Drift:
    """A model that can be pickled."""

    def step(self, state, action):
        return state + action, -state.square().sum(dim=1)

    def value(self, state):
        return state[:, 0]


def test_compile_rollout_survives_pickling():
    again = pickle.loads(pickle.dumps(compile_rollout(Drift(), backend="eager")))
    rewards, last = again.rollout(torch.ones(5, 2), torch.ones(5, 3, 2))
    assert rewards[0].tolist() == [-2.0, -8.0, -18.0] and again.value(last).tolist() == [4.0] * 5
