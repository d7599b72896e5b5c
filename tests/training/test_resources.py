"""Resources of a run: threads."""

import pytest
import torch

from latentplan.training import resources
from latentplan.training.resources import choose_collector_threads


@pytest.mark.parametrize(("cores", "expected"), [(1, 1), (2, 1), (8, 2), (16, 4), (64, 4)])
def test_choose_collector_threads_takes_some_of_the_cores_beside_a_gpu(cores, expected, monkeypatch):
    monkeypatch.setattr(resources, "count_cores", lambda: cores)
    assert choose_collector_threads(torch.device("cuda")) == expected
    assert choose_collector_threads(torch.device("cpu")) == 1
