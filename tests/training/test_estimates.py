"""Estimates of a run: the rows of its replay."""

from dataclasses import replace

import pytest

from latentplan.config import CollectionConfig, Config, EnvConfig, ReplayConfig, RunConfig
from latentplan.training.estimates import count_replay_rows


@pytest.mark.parametrize("budget", [{"minutes": 600.0}, {"frames": 1000}])
def test_count_replay_rows_keeps_saved_rows_for_any_budget(budget):
    config = Config(run=RunConfig(**budget))
    fresh = count_replay_rows(config)
    assert fresh < count_replay_rows(config, 2 * 300_000) == 600_000
    assert count_replay_rows(replace(config, replay=ReplayConfig(capacity=5)), 2 * 300_000) == 5


def test_count_replay_rows_counts_the_last_frame_of_short_episodes():
    collection = CollectionConfig(episode_decisions=16)
    config = Config(run=RunConfig(frames=100_000), env=EnvConfig(action_repeat=1), collection=collection)
    assert count_replay_rows(config) >= 100_000 * 17 / 16
