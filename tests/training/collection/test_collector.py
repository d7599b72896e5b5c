"""Collection: rows for replay match what happened in the environment."""

import multiprocessing
import os
import signal

import numpy as np
import pytest
import torch

from latentplan.config import CollectionConfig, UserError
from latentplan.models import WorldModel
from latentplan.training.callbacks import choose_behaviour
from latentplan.training.collection.collector import Collector


def make_weights(config, seed=0):
    torch.manual_seed(seed)
    model = WorldModel(config.model, action_dim=1)
    return {name: value.numpy() for name, value in model.state_dict().items()}


@pytest.fixture
def make_collector(tiny, dot):
    collectors = []

    def make(env=dot, /, **changes):
        collectors.append(Collector(tiny("", **changes), env, "cpu"))
        return collectors[-1]

    yield make
    for collector in collectors:
        collector.close()


def read_places(frames):
    """Position of the dot in [-1, 1], from frames (n, 64, 64, 3) of a picture with 16 columns."""
    columns = frames[:, 0, :, 0].astype(float)
    return ((columns * np.arange(64)).sum(1) / columns.sum(1) / 4.0 - 0.375 - 7.5) / 7.0


def test_collector_returns_rows_that_obey_the_dynamics_of_the_environment(make_collector):
    collected = make_collector(collection={"short_share": 0.0}).collect(None, "random", 45, 0)
    (rows,) = collected.rows
    assert len(rows.frames) == 47  # each frame once; the last frames of two episodes have no action
    assert (collected.decisions, collected.env_frames, len(collected.episode_returns)) == (45, 45, 2)
    assert np.flatnonzero(rows.is_first).tolist() == [0, 21, 42]
    place = read_places(rows.frames)
    goes_on = ~rows.is_first[1:]
    expected = np.clip(place[:-1] + 0.2 * rows.actions[:-1, 0], -1.0, 1.0)
    half_a_column = 1.0 / 7.0
    assert np.abs(place[1:] - expected)[goes_on].max() <= half_a_column
    assert np.abs(1.0 - np.abs(place[1:]) - rows.rewards[:-1])[goes_on].max() <= half_a_column
    assert (rows.actions[[20, 41]] == 0.0).all() and (rows.rewards[[20, 41]] == 0.0).all()
    assert collected.episode_returns == pytest.approx([rows.rewards[:20].sum(), rows.rewards[21:41].sum()], rel=1e-5)


def test_collector_continues_episodes_between_rounds(make_collector):
    whole, parts = make_collector(), make_collector()
    (expected,) = whole.collect(None, "random", 30, 0).rows
    first, second = (parts.collect(None, "random", 15, counter).rows[0] for counter in (0, 1))
    joined = np.concatenate([first.is_first, second.is_first])
    assert np.array_equal(joined, expected.is_first)
    place = read_places(np.concatenate([first.frames[-1:], second.frames[:1]]))
    assert place[1] == pytest.approx(np.clip(place[0] + 0.2 * first.actions[-1, 0], -1, 1), abs=1.0 / 7.0)


def test_collector_marks_terminal_states_but_not_time_limits(make_collector, dot):
    class Ending(dot):
        def step(self, action):
            picture, reward, _, truncated, info = super().step(action)
            return picture, reward, self.steps == 4, truncated, info

    (ending,) = make_collector(Ending).collect(None, "random", 8, 0).rows
    assert ending.continues.tolist() == [1, 1, 1, 0, 1, 1, 1, 1, 0, 1]
    (limited,) = make_collector().collect(None, "random", 45, 0).rows
    assert (limited.continues == 1.0).all()


def test_collector_restarts_shortened_episodes_without_marking_terminal_states(make_collector):
    collector = make_collector(collection={"episode_decisions": 8, "short_share": 1.0})
    first, second = (collector.collect(None, "random", count, counter) for counter, count in enumerate((20, 10)))
    (rows,), (later,) = first.rows, second.rows
    assert np.flatnonzero(rows.is_first).tolist() == [0, 9, 18]
    assert np.flatnonzero(later.is_first).tolist() == [5]  # the third episode continues in the second round
    assert (rows.continues == 1.0).all() and (len(first.episode_returns), len(second.episode_returns)) == (2, 1)
    assert first.episode_returns == pytest.approx([rows.rewards[:8].sum(), rows.rewards[9:17].sum()], rel=1e-5)


@pytest.mark.parametrize(("share", "num_short"), [(0.0, 0), (0.25, 7), (0.5, 14)])
def test_collector_cuts_episodes_for_a_share_of_the_decisions(make_collector, share, num_short):
    collector = make_collector(collection={"episode_decisions": 8, "short_share": share})
    rounds = [collector.collect(None, "random", 48, counter) for counter in range(5)]
    starts = np.flatnonzero(np.concatenate([collected.rows[0].is_first for collected in rounds]))
    lengths = np.diff(starts) - 1  # decisions of the episodes that ended; whole ones have 20
    assert set(lengths) == {8, 20} if share else {20}
    short = lengths == 8
    assert short.sum() == num_short and lengths[short].sum() / lengths.sum() == pytest.approx(share, abs=0.06)
    num_returns = sum(len(collected.episode_returns) for collected in rounds)
    assert num_returns - (~short).sum() in (0, 1)  # the last one may be whole and just over


def test_collector_reports_returns_by_the_kind_of_an_episode_not_by_its_outcome(make_collector, dot):
    """An episode that ends before its cut counts no more than one that lives to be cut, or the mean would be lower."""

    class Ending(dot):
        def step(self, action):
            picture, reward, _, truncated, info = super().step(action)
            return picture, reward, self.steps == 3, truncated, info

    for share, num_counted in ((0.0, 16), (0.5, 8), (1.0, 16)):
        collector = make_collector(Ending, collection={"episode_decisions": 8, "short_share": share})
        assert len(collector.collect(None, "random", 48, 0).episode_returns) == num_counted


def test_restored_collector_cuts_the_same_episodes(make_collector):
    changes = {"collection": {"episode_decisions": 8, "short_share": 0.5}}
    whole, other = make_collector(**changes), make_collector(**changes)
    first = whole.collect(None, "random", 45, 0)
    other.restore(first.memory)
    rows, expected = (collector.collect(None, "random", 60, 1).rows[0] for collector in (other, whole))
    assert np.array_equal(rows.is_first, expected.is_first) and np.array_equal(rows.frames, expected.frames)


def test_evaluate_warns_when_the_film_cannot_be_written(make_collector, tmp_path):
    with pytest.warns(RuntimeWarning, match="no film at"):
        returns = make_collector().evaluate(2, film=tmp_path / "missing" / "film.webm")
    assert [len(returns[mode]) for mode in ("planner", "actor")] == [2, 2]


def test_evaluate_plays_whole_episodes_when_collection_shortens_them(make_collector, tiny):
    weights = make_weights(tiny(""))
    cut = make_collector(collection={"episode_decisions": 8, "short_share": 1.0})
    whole = make_collector()
    assert cut.evaluate(2, weights=weights) == whole.evaluate(2, weights=weights)


def test_collector_stores_the_belief_of_each_frame(make_collector, tiny):
    collector = make_collector()
    (rows,) = collector.collect(make_weights(tiny("")), "actor", 25, 0).rows
    assert rows.deter.shape == (26, 16)
    assert (rows.deter[[0, 21]] == 0.0).all()
    assert (np.abs(rows.deter[1:20]).sum(1) > 0.0).all()


@pytest.mark.parametrize("behaviour", ["planner", "actor"])
def test_collector_stores_the_belief_of_the_unturned_frame_when_the_agent_turns_frames(make_collector, tiny, behaviour):
    turns = {"model": {"turns": 4}, "learning": {"turned_share": 0.5}}
    config, collector = tiny("", **turns), make_collector(**turns)
    (rows,) = collector.collect(make_weights(config), behaviour, 10, 0).rows
    frames, actions = torch.from_numpy(rows.frames), torch.from_numpy(rows.actions)
    state = collector.model.see(torch.zeros(1, 16), frames[:1])
    for time in range(1, 10):
        state = collector.model.infer(state, actions[time - 1 : time], frames[time : time + 1])
        assert np.allclose(rows.deter[time], state.deter.detach().numpy(), atol=1e-4)


@pytest.mark.parametrize("behaviour", ["planner", "actor"])
def test_collector_repeats_a_round_with_the_same_seed_round_and_weights(make_collector, tiny, behaviour):
    weights = make_weights(tiny(""))
    one, same, other = (make_collector().collect(weights, behaviour, 12, counter).rows[0] for counter in (3, 3, 4))
    assert np.array_equal(one.actions, same.actions) and np.array_equal(one.frames, same.frames)
    assert not np.array_equal(one.actions, other.actions)
    assert np.abs(one.actions).max() <= 1.0


def test_choose_behaviour_gives_goals_their_share_and_alternates_planner_and_actor():
    settings = CollectionConfig(behaviour="both", goals=("a", "b"), goal_share=0.2, goals_after=1000)
    chosen = [choose_behaviour(settings, rounds, 100 * rounds) for rounds in range(60)]
    assert chosen[:10] == [("planner", None), ("actor", None)] * 5  # no goals before 1,000 frames
    assert [goal for _, goal in chosen[10:] if goal] == ["a", "b"] * 5
    assert {behaviour for behaviour, goal in chosen if goal} == {"planner"}
    others = [behaviour for behaviour, goal in chosen[10:] if goal is None]
    assert others == ["planner", "actor"] * 20


@pytest.mark.parametrize("behaviour", ["planner", "actor"])
def test_choose_behaviour_keeps_a_single_behaviour(behaviour):
    settings = CollectionConfig(behaviour=behaviour)
    assert {choose_behaviour(settings, rounds, 0) for rounds in range(5)} == {(behaviour, None)}


def test_collection_config_refuses_goals_without_share_and_share_without_goals():
    with pytest.raises(ValueError, match="goal_share needs goals"):
        CollectionConfig(goal_share=0.1)
    with pytest.raises(ValueError, match="need a goal_share"):
        CollectionConfig(goals=("upright",))


@pytest.fixture
def make_cart(tiny):
    collectors = []

    def make(**collection):
        config = tiny("", env={"domain": "cartpole", "task": "swingup"}, collection=collection)
        collectors.append(Collector(config, None, "cpu"))
        return collectors[-1]

    yield make
    for collector in collectors:
        collector.close()


def test_collector_plans_for_the_goal_of_a_round(make_cart):
    collector = make_cart(goals=("cart -> 0.8", "cart -> -0.8"), goal_share=0.5, noise_std=0.0)
    weights = {name: value.numpy().copy() for name, value in collector.model.state_dict().items()}
    planned_for = []
    for counter, goal in enumerate((None, "cart -> 0.8", "cart -> -0.8", None)):
        collector.collect(weights, "planner", 2, counter, goal)
        planned_for.append(collector._current_agent.controller.objective)
    reward, right, left, again = planned_for
    assert reward is None and again is None
    assert right is not None and left is not None and right is not left


@pytest.mark.parametrize(("goal", "message"), [("cart -> ", "expected"), ("height > 1.0", "height")])
def test_collector_refuses_goals_that_cannot_be_pursued(make_cart, goal, message):
    with pytest.raises(UserError, match=message):
        make_cart(goals=("cart -> 0.5", goal), goal_share=0.5)


def test_evaluate_neither_explores_nor_disturbs_collection(make_collector, tiny):
    weights = make_weights(tiny(""))
    evaluated, plain = make_collector(), make_collector()
    for collector in (evaluated, plain):
        collector.collect(weights, "planner", 7, 0)
    first, again = evaluated.evaluate(2), evaluated.evaluate(2)
    assert evaluated.evaluate(2, actor=False) == {"planner": first["planner"]}
    assert first == again and first.keys() == {"planner", "actor"}
    assert all(len(returns) == 2 for returns in first.values())
    following = [collector.collect(weights, "planner", 7, 1).rows[0] for collector in (evaluated, plain)]
    assert np.array_equal(following[0].actions, following[1].actions)
    assert np.array_equal(following[0].frames, following[1].frames)


def test_collector_stores_the_labels_of_an_episodes_last_frame(make_cart):
    settings = {"episode_decisions": 5, "short_share": 1.0}
    alone, followed = (make_cart(**settings).collect(None, "random", n, 0).rows[0] for n in (5, 10))
    assert followed.is_first[6] and np.array_equal(followed.labels[:6], alone.labels)
    assert not np.array_equal(followed.labels[5], followed.labels[6])


@pytest.fixture(scope="module")
def two_environments(tiny, dot):
    """A collector of two environments in processes of their own, with info entries of changing length."""

    class Tracing(dot):
        def step(self, action):
            *rest, _ = super().step(action)
            return *rest, {"trace": np.zeros(self.steps + int(10 * abs(self.place)))}

    collector = Collector(tiny("", env={"num_envs": 2}), Tracing, "cpu")
    yield collector
    collector.close()


def test_collector_accepts_info_entries_of_changing_length_from_several_environments(two_environments):
    first, second = two_environments.collect(None, "random", 12, 0).rows
    assert len(first.frames) == len(second.frames) >= 6


def test_environments_in_processes_ignore_interrupts(two_environments):
    children = multiprocessing.active_children()
    assert len(children) == 2
    for child in children:
        os.kill(child.pid, signal.SIGINT)
    assert two_environments.collect(None, "random", 6, 0).decisions == 6


def test_close_returns_after_a_step_that_failed(two_environments, monkeypatch):
    """Runs last in this file: the environments are closed after it."""
    monkeypatch.setattr("latentplan.training.collection.collector.CLOSING_SECONDS", 0.2)
    two_environments.collect(None, "random", 4, 0)
    monkeypatch.setattr(two_environments._episodes.envs, "_info", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        two_environments.collect(None, "random", 4, 1)
    two_environments.close()
