"""Episodes that end by failing: plans weigh the end once one was seen, and several environments restart one by one."""

import json
from dataclasses import replace

import numpy as np
import pytest

from latentplan import load_agent
from latentplan.config import PlannerConfig
from latentplan.training import resume, train
from latentplan.training.collection.collector import Collector
from tests.training.dot import Dot


class Cliff(Dot):
    """A dot whose episode ends in a terminal state where the dot reaches an end of the picture."""

    def step(self, action):
        picture, reward, _, truncated, info = super().step(action)
        return picture, reward, abs(self.place) == 1.0, truncated, info


def saved_setting(folder):
    return json.loads((folder / "checkpoints" / "last" / "info.json").read_text())["config"]["planner"]["use_continues"]


@pytest.fixture(scope="module")
def cliff(tiny, tmp_path_factory):
    return train(tiny(tmp_path_factory.mktemp("runs") / "cliff", run={"frames": 60}), Cliff).run_dir


def test_agents_weigh_the_end_if_the_run_has_seen_one(cliff):
    assert saved_setting(cliff) is True
    assert load_agent(cliff).controller.planner.use_continues is True
    resume(cliff, frames=75, make_env=Cliff)
    assert saved_setting(cliff) is True


def test_agents_do_not_weigh_an_end_that_the_run_has_not_seen(finished):
    assert saved_setting(finished.run_dir) is False


@pytest.mark.parametrize("given", [True, False])
def test_settings_prevail_over_what_was_seen(given, tiny, tmp_path):
    config = tiny(tmp_path / "run", planner={"use_continues": given}, run={"frames": 60})
    assert saved_setting(train(config, Cliff).run_dir) is given


@pytest.mark.parametrize("given", [None, False])
def test_plans_of_a_collector_weigh_the_end_from_the_first_one_on(given, tiny):
    config = tiny("unused", planner={"use_continues": given})
    collector = Collector(config, Cliff, "cpu")
    planners = [collector._agents["planner"], collector._agents["goal"], collector._evaluation_agents["planner"]]
    before = [agent.controller.planner.use_continues for agent in planners]
    round_ = collector.collect(None, "planner", 60, 0)
    assert (np.concatenate([rows.continues for rows in round_.rows]) == 0.0).any()
    after = [agent.controller.planner.use_continues for agent in planners]
    assert not any(before) and after == [given is None] * 3
    other = Collector(config, Cliff, "cpu")
    other.restore(round_.memory)
    assert other._agents["planner"].controller.planner.use_continues == planners[0].controller.planner.use_continues
    collector.close()
    other.close()


def test_environments_that_end_restart_alone(tiny):
    config = tiny("unused", env={"num_envs": 2, "action_repeat": 1})
    collector = Collector(config, Cliff, "cpu")
    rows = collector.collect(None, "planner", 120, 0).rows
    collector.close()
    firsts = [np.flatnonzero(lane.is_first) for lane in rows]
    assert len(firsts[0]) > 1 and not np.array_equal(*firsts)  # the environments begin at different times
    for lane, begun in zip(rows, firsts, strict=True):
        ends = np.flatnonzero(lane.continues == 0.0)
        assert len(ends) > 0
        assert np.isin(ends[ends + 2 < len(lane.frames)] + 2, begun).all()  # the last frame, then the next episode
        assert not lane.actions[begun[1:] - 1].any()  # the last row of an episode has no action


def test_default_search_does_not_weigh_the_end():
    assert PlannerConfig().use_continues is None
    assert replace(PlannerConfig(), use_continues=True).use_continues is True
