"""A session plays as an evaluation does, and takes other settings between two decisions."""

from dataclasses import replace

import numpy as np
import pytest

from latentplan.agents.checkpoint import make_loaded_agent
from latentplan.config import UserError
from latentplan.config.quantities import scales
from latentplan.evaluation import evaluate_agent
from latentplan.reporting.page import encode_png
from latentplan.view.session import MOST_WEIGHTS, NUM_PICTURES
from tests.view.conftest import CONFIG


def change(session, **changes):
    session.change(replace(session.settings, **changes))


def test_session_plays_the_episodes_of_an_evaluation_with_the_same_seed(make_session, trained):
    session = make_session(seed=5, action_repeat=100)
    moments = [session.decide() for _ in range(20)]
    assert [moment.episode for moment in moments] == [1] * 10 + [2] * 10
    played = []
    evaluate_agent(
        make_loaded_agent(*trained), session.env, seed=5, episodes=2, on_step=lambda step: played.append(step.action)
    )
    expected = [action for action in played if action is not None]
    assert np.array_equal(np.stack([moment.action for moment in moments]), np.stack(expected))


def test_looking_ahead_changes_no_action(make_session):
    plain, looking = make_session(), make_session()
    for _ in range(6):
        one, other = plain.decide(), looking.decide(looks_ahead=True)
        assert np.array_equal(one.action, other.action) and np.array_equal(one.frame, other.frame)
    assert one.future is None and other.future is not None


@pytest.mark.parametrize(("mode", "rows"), [("planner", ["plan", "actor"]), ("actor", ["actor"])])
def test_future_has_a_row_of_pictures_for_each_way_of_acting(make_session, mode, rows):
    session = make_session(mode=mode)
    future = session.decide(looks_ahead=True).future
    assert list(future.rewards) == rows
    assert future.steps == [1, 2, 3] and len(future.steps) <= NUM_PICTURES
    assert future.picture.shape == (33 * len(rows) - 1, 33 * 3 - 1, 3)
    assert (future.fan is not None) == (mode == "planner")
    if future.fan is not None:
        assert future.fan.elites.shape == (4, 3, 1) and future.fan.candidates.shape[1:] == (3, 1)
        assert future.fan.mean.shape == (3, 1)


def test_random_mode_has_no_future_and_no_surprise(make_session):
    moment = make_session(mode="random").decide(looks_ahead=True)
    assert moment.future is None and moment.surprise is None and moment.source == "actor"


def test_changed_search_reaches_the_planner_and_the_belief_goes_on(session):
    session.decide()
    belief = [part.clone() for part in session.agent.state]
    change(session, planner={"horizon": 2, "num_samples": 24, "num_iterations": 3, "deadline_ms": 500.0})
    planner = session.agent.controller.planner
    assert (planner.horizon, planner.num_samples, planner.num_iterations) == (2, 24, 3)
    assert planner.deadline_ms == 500.0
    assert all(np.array_equal(old, new) for old, new in zip(belief, session.agent.state, strict=True))
    moment = session.decide(looks_ahead=True)
    assert moment.decision == 1 and moment.future.num_steps == 2


@pytest.mark.parametrize("mode", ["actor", "gated", "random", "background"])
def test_changed_mode_goes_on_in_the_same_episode(session, mode):
    session.decide()
    change(session, mode=mode)
    assert session.decide().decision == 1
    change(session, mode="planner")
    moment = session.decide()
    assert moment.decision == 2 and moment.source == "plan"


def test_changed_objective_and_constraint_reach_the_planner_and_are_scored(session):
    session.decide()
    assert session.agent.controller.objective is None
    change(session, objective="cart -> 0.8", constraint="cart_speed < 5")
    assert session.agent.controller.objective is not None and len(session.agent.controller.constraints) == 1
    session.decide()
    moment = session.decide()
    assert 0.0 <= moment.score <= 1.0
    assert [text for text, _ in moment.clauses] == ["cart -> 0.8", "cart_speed < 5"]
    change(session, objective=None, constraint=None)
    assert session.agent.controller.objective is None and not session.agent.controller.constraints
    assert session.decide().clauses == []


def test_objectives_of_a_schedule_begin_when_they_are_set(session):
    session.decide()
    change(session, objective="cart -> 0.8; 10: cart -> -0.8")
    first = session.agent.controller.objective
    session.decide()  # ten env frames
    assert session.agent.controller.objective is not first
    change(session, objective="cart -> 0.8; 20: cart -> -0.8")
    first = session.agent.controller.objective
    session.decide()
    assert session.agent.controller.objective is first


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"objective": "speed -> 2.0"}, "'speed'"),
        ({"objective": "cart -> "}, "the end"),
        ({"objective": "task(balance)"}, "cannot plan for 'task.balance'"),
        ({"objective": "cart -> 0.1; 10: task(balance)"}, "cannot plan for 'task.balance'"),
        ({"objective": "goal:other.png"}, "there is no goal picture 'other.png'"),
        ({"constraint": "cart"}, "cart"),
        ({"planner": {"num_elites": 100}}, "num_elites (100) must not exceed num_samples (16)"),
        ({"planner": {"horizon": 0}}, "horizon must be a whole number"),
        ({"mode": "actor", "planner": {"horizon": 0}}, "horizon must be a whole number"),
        ({"mode": "gated", "objective": "task(balance)"}, "cannot plan for 'task.balance'"),
    ],
)
def test_settings_that_cannot_be_used_leave_the_old_ones(session, changes, words):
    change(session, objective="cart -> 0.8")
    session.decide()
    before, objective = session.settings, session.agent.controller.objective
    agent, clauses = session.agent, [text for text, _ in session.decide().clauses]
    with pytest.raises(UserError) as error:
        change(session, **changes)
    assert words in str(error.value) and "\n" not in str(error.value)
    assert session.settings == before and session.agent is agent
    if "task(balance)" not in changes.get("objective", ""):
        assert agent.controller.objective is objective
    assert agent.controller.objective is not None
    session.decide()
    assert [text for text, _ in session.decide().clauses] == clauses == ["cart -> 0.8"]


def test_refused_goal_leaves_the_present_objective_of_a_schedule(make_session, monkeypatch):
    session = make_session(objective="cart -> 0.8; 20: cart -> -0.8; 1000: cart -> 0.1", constraint="cart_speed < 5")
    pursued, set_objective = [], session.agent.set_objective

    def note(objective=None, constraints=()):
        set_objective(objective, constraints)
        pursued.append((getattr(objective, "text", None), constraints))

    monkeypatch.setattr(session.agent, "set_objective", note)
    for num_decisions, present in ((1, "cart -> 0.8"), (2, "cart -> -0.8")):
        for _ in range(num_decisions):
            session.decide()
        with pytest.raises(UserError, match="cannot plan for"):
            change(session, objective="task(balance)")
        assert pursued[-1] == (present, "cart_speed < 5")


def test_push_moves_the_body_and_ends(make_session):
    pushed, plain = make_session(), make_session()
    for each in (pushed, plain):
        each.decide()
    assert pushed.env.pushed_body == "cart"
    pushed.push(pushed.weight)
    forces = []
    for _ in range(4):
        forces.append(pushed.env.physics.data.xfrc_applied.copy())
        moment = pushed.decide()
        plain.decide()
    assert [bool(force.any()) for force in forces] == [True, True, False, False]  # 0.2 s are two decisions
    assert not pushed.env.physics.data.xfrc_applied.any() and not moment.is_pushed
    assert abs(pushed.env.true_state()[0] - plain.env.true_state()[0]) > 0.05


def test_push_ends_with_the_episode(session):
    session.decide()
    session.push(session.weight)
    session.restart()
    moment = session.decide()
    assert not session.env.physics.data.xfrc_applied.any() and not moment.is_pushed


def test_push_refuses_forces_that_break_the_simulation(session):
    session.decide()
    for force in (2 * MOST_WEIGHTS * session.weight, -np.inf, np.nan):
        with pytest.raises(UserError, match="a push must be within"):
            session.push(force)
    assert not session.env.physics.data.xfrc_applied.any()


def test_restart_begins_the_next_episode(session):
    first = [session.decide() for _ in range(3)][0]
    session.restart()
    moment = session.decide()
    assert (moment.episode, moment.decision, moment.total_return) == (2, 0, 0.0)
    assert not np.array_equal(moment.frame, first.frame)


def test_moment_has_the_true_quantities_of_its_frame(session):
    moment = session.decide()
    assert list(moment.quantities) == list(scales("cartpole"))
    assert moment.quantities["cart"] != pytest.approx(session.env.physics.named.data.qpos["slider"][0], abs=1e-9)
    following = session.decide()
    assert following.surprise >= 0.0 and following.decision_ms > 0.0


def test_goal_picture_of_the_camera_can_be_pursued(session):
    session.decide()
    name = session.pictures.add(encode_png(session.present_frame()))
    change(session, objective=f"goal:{name}")
    assert session.agent.controller.objective is not None and session.settings.objective == f"goal:{name}"
    session.decide()
    assert session.decide().score is not None


def test_session_keeps_the_settings_of_the_agent(session):
    assert session.search == CONFIG.planner
