"""The table of agent modes: every mode is usable, and a new row in the table is enough for a new mode."""

import copy
import pickle

import numpy as np
import pytest
import torch

from latentplan.agents.checkpoint import load_agent, save_checkpoint
from latentplan.agents.modes import MODES, AgentMode, planning_modes
from latentplan.agents.planning import PlanningAgent
from latentplan.config import UserError
from latentplan.models.fast import accelerate
from tests.agents.small_agents import CONFIG, make_model, make_plain_model

FRAME = np.zeros((64, 64, 3), np.uint8)
HERE = "tests.agents.test_modes"
GOAL = "cart -> 0.5 and cart_speed < 1"


class ReversedAgent(PlanningAgent):
    """Executes the negative of each planned action, times a factor."""

    def __init__(self, model, config, discount, *, planner=None, factor=1.0):
        super().__init__(model, config, discount, planner=planner)
        self.factor = factor

    def _choose(self, state):
        return -self.factor * super()._choose(state)


class RestingAgent:
    """Executes zeros."""

    def __init__(self, model, config):
        self.num_actions = model.action_dim

    def seed(self, seed):
        pass

    def reset(self):
        pass

    def act(self, frame):
        return np.zeros(self.num_actions, np.float32)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    folder = tmp_path_factory.mktemp("agent")
    info = {"domain": "cartpole", "task": "swingup", "env_frames": 1, "discount": 0.9}
    save_checkpoint(folder, make_model(), CONFIG, info)
    return folder


def test_table_needs_the_standard_library_only(run_python):
    code = (
        "import sys\nbefore = set(sys.modules)\nimport latentplan.agents.modes\n"
        "new = {name.split('.')[0] for name in set(sys.modules) - before}\n"
        "print(sorted(new - sys.stdlib_module_names))"
    )
    finished = run_python("-c", code)
    assert finished.stdout.strip() == "['latentplan']", finished.stderr


def test_planning_modes_lists_modes_of_agents_with_set_objective():
    assert planning_modes() == ("planner", "gated", "background")
    for name, mode in MODES.items():
        assert hasattr(mode.load(), "set_objective") == mode.plans, name


def test_registered_mode_that_plans_is_loaded_with_planner_settings_and_its_own_options(checkpoint, monkeypatch):
    monkeypatch.setitem(MODES, "reversed", AgentMode(f"{HERE}:ReversedAgent", plans=True, options=("factor",)))
    plain, reversed_agent = load_agent(checkpoint, horizon=2), load_agent(checkpoint, "reversed", horizon=2, factor=0.5)
    assert reversed_agent.controller.planner.horizon == 2
    assert np.allclose(reversed_agent.act(FRAME), -0.5 * plain.act(FRAME), atol=1e-6)
    with pytest.raises(UserError, match="did you mean factor?"):
        load_agent(checkpoint, "reversed", facter=0.5)
    with pytest.raises(UserError, match="planner, gated, background, actor, random, reversed, got 'revers'"):
        load_agent(checkpoint, "revers")


def test_registered_mode_that_does_not_plan_takes_no_planner_settings(checkpoint, monkeypatch):
    monkeypatch.setitem(MODES, "resting", AgentMode(f"{HERE}:RestingAgent"))
    assert load_agent(checkpoint, "resting").act(FRAME).tolist() == [0.0, 0.0]
    with pytest.raises(UserError, match="horizon has no effect in mode resting"):
        load_agent(checkpoint, "resting", horizon=2)


@pytest.fixture(scope="module")
def with_goals(tmp_path_factory):
    """A checkpoint of an agent with heads for goals."""
    folder = tmp_path_factory.mktemp("with-goals")
    model = make_plain_model(labels={"cart": 1.0, "cart_speed": 1.0})
    model.add_goal_heads(8)
    info = {"domain": "cartpole", "task": "swingup", "env_frames": 1, "discount": 0.9}
    save_checkpoint(folder, accelerate(model), CONFIG, info)
    return folder


REPEATABLE = sorted(MODES.keys() - {"background"})  # whose actions depend on the clock


def play(checkpoint, film, mode):
    """Actions of two short episodes, the second one for a goal."""
    agent = load_agent(checkpoint, mode, device="cpu")
    agent.seed(0)
    actions = [agent.act(frames) for frames in film]
    agent.reset()
    if MODES[mode].plans:
        agent.set_objective(GOAL)
        agent.act(film[0])
        agent.imagine_along([agent.belief()], None, 2)
    return np.concatenate([*actions, *(agent.act(frames) for frames in film)])


@pytest.mark.parametrize("mode", REPEATABLE)
def test_actions_do_not_depend_on_torchs_default_device(with_goals, film, mode):
    expected = play(with_goals, film, mode)
    with torch.device("meta"):  # a tensor on this device has no numbers, so that its use fails
        assert np.array_equal(play(with_goals, film, mode), expected)


@pytest.mark.parametrize("mode", REPEATABLE)
def test_actions_do_not_depend_on_torchs_default_dtype(with_goals, film, mode):
    expected = play(with_goals, film, mode)
    torch.set_default_dtype(torch.float64)
    try:
        assert np.array_equal(play(with_goals, film, mode), expected)
    finally:
        torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda agent: pickle.loads(pickle.dumps(agent))])
@pytest.mark.parametrize("mode", REPEATABLE)
def test_agent_that_has_acted_can_be_copied_and_acts_on_alike(with_goals, film, mode, copied):
    agent = load_agent(with_goals, mode, device="cpu")
    agent.seed(0)
    agent.act(film[0])
    twin = copied(agent)
    assert all(np.array_equal(twin.act(frames), agent.act(frames)) for frames in film[1:])
