"""Resources of a run: threads and the size of the replay."""

from dataclasses import replace

import pytest
import torch

from latentplan.config import CollectionConfig, Config, EnvConfig, ReplayConfig, RunConfig
from latentplan.training import resources
from latentplan.training.resources import choose_collector_threads, choose_replay_capacity


@pytest.mark.parametrize("budget", [{"minutes": 600.0}, {"frames": 1000}])
def test_choose_replay_capacity_keeps_saved_rows_for_any_budget(budget):
    config = Config(run=RunConfig(**budget))
    fresh = choose_replay_capacity(config, (0, 0))
    assert fresh < choose_replay_capacity(config, (2, 300_000)) == 600_000
    assert choose_replay_capacity(replace(config, replay=ReplayConfig(capacity=5)), (2, 300_000)) == 5


def test_choose_replay_capacity_counts_the_last_frame_of_short_episodes():
    collection = CollectionConfig(episode_decisions=16)
    config = Config(run=RunConfig(frames=100_000), env=EnvConfig(action_repeat=1), collection=collection)
    assert choose_replay_capacity(config, (0, 0)) >= 100_000 * 17 / 16


@pytest.mark.parametrize(("cores", "expected"), [(1, 1), (2, 1), (8, 2), (16, 4), (64, 4)])
def test_choose_collector_threads_takes_some_of_the_cores_beside_a_gpu(cores, expected, monkeypatch):
    monkeypatch.setattr(resources, "count_cores", lambda: cores)
    assert choose_collector_threads(torch.device("cuda")) == expected
    assert choose_collector_threads(torch.device("cpu")) == 1
