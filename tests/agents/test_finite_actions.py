"""No mode returns an action that is not finite, whatever the weights, the belief or the frame hold."""

import warnings

import numpy as np
import pytest
import torch

from latentplan.agents.export import export_actor
from latentplan.agents.modes import MODES, make_agent
from latentplan.models.fast import accelerate
from tests.agents.small_agents import CONFIG, make_plain_model

LEARNED = [mode for mode in MODES if mode != "random"]


@pytest.fixture
def make():
    """Makes an agent with its own model; the agents are closed after the test."""
    made = []

    def build(mode, fast=False):
        model = make_plain_model()
        options = {"worker": "thread"} if mode == "background" else {}
        made.append(make_agent(mode, accelerate(model) if fast else model, CONFIG, 0.9, **options))
        return made[-1]

    yield build
    for agent in made:
        getattr(agent, "close", lambda: None)()


def break_weights(agent):
    with torch.no_grad():
        for weights in agent.model.parameters():
            weights.fill_(float("nan"))


@pytest.mark.parametrize("fast", [False, True])
@pytest.mark.parametrize("mode", LEARNED)
def test_agent_repeats_its_last_finite_action_when_its_weights_are_nan(mode, fast, make, film):
    agent = make(mode, fast)
    for frames in film[:2]:
        before = agent.act(frames)
    assert np.isfinite(before).all() and agent.num_replaced_actions == 0
    break_weights(agent)
    with pytest.warns(RuntimeWarning, match="not finite|nothing finite") as caught:
        after = [agent.act(frames) for frames in film[2:]]
    assert sum("agent's action" in str(entry.message) for entry in caught) <= 1
    assert np.isfinite(after).all() and np.abs(after).max() <= 1.0
    if agent.num_replaced_actions:  # searches fall back on the last plan and on zeros themselves
        assert agent.num_replaced_actions % 3 == 0
    if mode == "actor":
        assert np.array_equal(after, [before] * 3) and agent.num_replaced_actions == 9


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_agent_with_nan_weights_starts_with_finite_actions(mode, make, film):
    agent = make(mode)
    if mode != "random":
        break_weights(agent)
    for frames in (film[0, 0], film[1, 0]):
        action = agent.act(frames)
        assert action.shape == (2,) and action.dtype == np.float32 and np.isfinite(action).all()
        assert mode == "random" or (action == 0.0).all()


@pytest.mark.parametrize("mode", LEARNED)
def test_agent_replaces_the_actions_of_a_broken_environment_alone(mode, make, film):
    agent, whole = make(mode), make(mode)
    for frames in film[:2]:
        agent.act(frames)
        whole.act(frames)
    with torch.inference_mode():
        agent.state.deter[1] = float("nan")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        action, expected = agent.act(film[2]), whole.act(film[2])
    assert np.isfinite(action).all() and np.isfinite(expected).all()
    if mode == "actor":
        assert np.array_equal(action[[0, 2]], expected[[0, 2]]) and agent.num_replaced_actions == 1


@pytest.mark.parametrize("mode", LEARNED)
def test_replaced_action_is_zero_after_a_reset(mode, make, film):
    agent = make(mode)
    agent.act(film[0])
    agent.reset(np.array([True, False, True]))
    break_weights(agent)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        action = agent.act(film[1])
    assert np.isfinite(action).all() and (action[[0, 2]] == 0.0).all()


@pytest.mark.parametrize("mode", LEARNED)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_act_refuses_frames_that_are_not_finite(mode, value, make):
    with pytest.raises(ValueError, match="frames must be uint8"):
        make(mode).act(np.full((64, 64, 3), value))


def test_exported_actor_repeats_its_last_action_when_its_weights_are_nan(make, tmp_path):
    agent = make("actor")
    break_weights(agent)
    program = torch.export.load(export_actor(agent, tmp_path / "actor.pt2")).module()
    frame, last = torch.zeros(2, 64, 64, 3, dtype=torch.uint8), torch.tensor([[0.5, -0.5], [0.25, float("nan")]])
    action, _, _ = program(frame, torch.zeros(2, 16), torch.zeros(2, 32), last, torch.tensor([False, False]))
    assert action.tolist() == [[0.5, -0.5], [0.25, 0.0]]
    action, _, _ = program(frame, torch.zeros(2, 16), torch.zeros(2, 32), last, torch.tensor([True, True]))
    assert (action == 0.0).all()
