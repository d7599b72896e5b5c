"""Resources of a run: threads and the size of the replay."""

from dataclasses import replace

import pytest
import torch

from latentplan.config import CollectionConfig, Config, EnvConfig, ReplayConfig, RunConfig
from latentplan.replay.buffer import FRAME_BYTES
from latentplan.training import resources
from latentplan.training.resources import choose_collector_threads, choose_replay_capacity


@pytest.mark.parametrize("budget", [{"minutes": 600.0}, {"frames": 1000}])
def test_choose_replay_capacity_keeps_saved_rows_for_any_budget(budget, tmp_path):
    config = Config(run=RunConfig(**budget))
    fresh = choose_replay_capacity(config, tmp_path)
    for lane, rows in enumerate((300_000, 299_999)):
        with (tmp_path / f"frames_{lane}.u8").open("wb") as file:
            file.truncate(rows * FRAME_BYTES)  # a sparse file, which takes no disk space
    assert fresh < choose_replay_capacity(config, tmp_path) == 600_000
    assert choose_replay_capacity(replace(config, replay=ReplayConfig(capacity=5)), tmp_path) == 5


def test_choose_replay_capacity_counts_the_last_frame_of_short_episodes(tmp_path):
    collection = CollectionConfig(episode_decisions=16)
    config = Config(run=RunConfig(frames=100_000), env=EnvConfig(action_repeat=1), collection=collection)
    assert choose_replay_capacity(config, tmp_path) >= 100_000 * 17 / 16


@pytest.mark.parametrize(("cores", "expected"), [(1, 1), (2, 1), (8, 2), (16, 4), (64, 4)])
def test_choose_collector_threads_takes_some_of_the_cores_beside_a_gpu(cores, expected, monkeypatch):
    monkeypatch.setattr(resources, "count_cores", lambda: cores)
    assert choose_collector_threads(torch.device("cuda")) == expected
    assert choose_collector_threads(torch.device("cpu")) == 1
