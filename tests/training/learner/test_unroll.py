"""A complete update with the written-out gradients of `GpuBackend`, on the CPU."""

import torch

from latentplan.models.backend import Backend
from latentplan.models.fast import GpuBackend
from tests.training.learner.test_graphed import draw_rows, make_graphed


def test_update_with_written_out_gradients_equals_the_update_with_autograd(tiny):
    learners = []
    for backend in (Backend(), GpuBackend()):
        learner = make_graphed(tiny)
        learner.model.backend = learner.snapshot.model.backend = backend
        for rows in draw_rows(learner.replay, 2):
            learner.training_step(rows, 0)
        learners.append(learner)
    plain, fast = learners
    for name, value in plain.metrics.items():
        torch.testing.assert_close(fast.metrics[name], value, rtol=1e-4, atol=1e-5, msg=name)
    weights = fast.state_dict()
    for name, value in plain.state_dict().items():
        torch.testing.assert_close(weights[name], value, rtol=1e-2, atol=1e-4, msg=name)
