"""A whole update with the written-out gradients of `GpuBackend`, on the CPU."""

import torch

from latentplan.models.backend import Backend
from latentplan.models.fast import GpuBackend
from tests.training.learner.test_graphed import draws, graphed


def test_update_with_written_out_gradients_equals_the_update_with_autograd(tiny):
    learners = []
    for backend in (Backend(), GpuBackend()):
        learner = graphed(tiny)
        learner.model.backend = learner.snapshot.model.backend = backend
        for rows in draws(learner.replay, 2):
            learner.training_step(rows, 0)
        learners.append(learner)
    (expected, parts), (given, own) = ((learner.state_dict(), learner.metrics) for learner in learners)
    for name, value in parts.items():
        torch.testing.assert_close(own[name], value, rtol=1e-4, atol=1e-5, msg=name)
    for name, value in expected.items():
        torch.testing.assert_close(given[name], value, rtol=1e-2, atol=1e-4, msg=name)
