"""An integrator, whose state is the sum of its actions, and a wait for a plan that is made in the background."""

import time

import torch


def dynamics(state, action):
    return state + action


def reward(state, action):
    return -(state + action).square().sum(dim=1)


def policy(state, generator):
    return torch.full((len(state), 1), 0.05)


def wait_for_plan(background, seconds=20.0):
    """Returns the next tick and plan of a background planner."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        finished = background.poll()
        if finished is not None:
            return finished
        time.sleep(0.002)
    raise AssertionError("no plan came")
