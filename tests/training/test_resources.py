"""Resources of a run: threads."""

from dataclasses import replace

import pytest
import torch

from latentplan.config import CollectionConfig, Config, RunConfig, estimates
from latentplan.training import resources
from latentplan.training.resources import choose_collector_threads


@pytest.mark.parametrize(("cores", "expected"), [(1, 1), (2, 1), (8, 2), (16, 4), (64, 4)])
def test_choose_collector_threads_takes_some_of_the_cores_beside_a_gpu(cores, expected, monkeypatch):
    monkeypatch.setattr(resources, "count_cores", lambda: cores)
    assert choose_collector_threads(torch.device("cuda")) == expected
    assert choose_collector_threads(torch.device("cpu")) == 1


@pytest.mark.parametrize(
    ("changes", "beside"),
    [({}, 1), ({"workers": 3}, 3), ({"overlap": False}, 0), ({"workers": 17, "backend": "ray"}, 17)],
)
def test_collection_processes_of_this_machine_are_counted_without_those_of_a_cluster(changes, beside):
    collection = replace(CollectionConfig(), **changes)
    assert Config(collection=collection).local_collectors == beside
    if changes.get("backend") == "ray":
        run = RunConfig(ray_address="head:6379")
        assert Config(collection=collection, run=run).local_collectors == 1


@pytest.mark.parametrize(
    ("files", "cores"),
    [
        ({"cpu.max": "200000 100000"}, 2),
        ({"cpu.max": "50000 100000"}, 1),
        ({"cpu.max": "max 100000"}, 8),
        ({"cpu/cpu.cfs_quota_us": "250000", "cpu/cpu.cfs_period_us": "100000"}, 3),
        ({"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, 8),
        ({}, 8),
    ],
)
def test_cores_are_counted_within_the_quota_of_a_container(files, cores, tmp_path, monkeypatch):
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(f"{text}\n")
    monkeypatch.setattr(estimates, "CONTROL_GROUP", tmp_path)
    monkeypatch.setattr("os.sched_getaffinity", lambda pid: set(range(8)))
    assert estimates.count_cores() == cores
