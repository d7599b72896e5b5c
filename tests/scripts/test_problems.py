"""The problems of `scripts/bench/problems.py`: batch independence, gradients, bounds and known optima."""

import pytest
import torch
from bench.problems import PROBLEMS

from latentplan.planning import CEMPlanner, ModelPredictiveController, check_model

problems = pytest.mark.parametrize("problem", PROBLEMS.values(), ids=PROBLEMS)


@problems
def test_problem_is_a_model_that_can_be_planned_with(problem):
    check_model(problem.model(), problem.start([0, 1]), problem.action_dim)


@problems
def test_start_depends_on_its_own_seed_only(problem):
    starts = problem.start([3, 4])
    assert torch.equal(starts[1:], problem.start([4])) and not torch.equal(starts[0], starts[1])


@problems
def test_run_sums_the_cost_of_every_step(problem):
    def act(state):
        return torch.full((len(state), problem.action_dim), 9.0)  # beyond the bounds, so clamped

    state, total = problem.start([0, 1]), torch.zeros(2)
    for _ in range(problem.num_steps):
        action = torch.full((2, problem.action_dim), problem.action_high)
        total += problem.cost(state, action)
        state = problem.dynamics(state, action)
    torch.testing.assert_close(problem.run(act, [0, 1]), total)


@problems
def test_cost_is_differentiable_everywhere_on_a_run(problem):
    state = problem.start([0]).requires_grad_()
    action = torch.zeros(1, problem.action_dim, requires_grad=True)
    cost = problem.cost(problem.dynamics(state, action), action).sum()
    gradients = torch.autograd.grad(cost, [state, action])
    assert all(torch.isfinite(gradient).all() and gradient.abs().sum() > 0 for gradient in gradients)


def test_riccati_controller_without_bounds_reaches_the_lower_bound():
    """The bound is the cost of a plan, so gradient descent on unbounded actions reaches it."""
    problem = PROBLEMS["lq"]
    actions = torch.zeros(problem.num_steps, 1, problem.action_dim, requires_grad=True)
    descent = torch.optim.LBFGS([actions], max_iter=60, line_search_fn="strong_wolfe")

    def total():
        descent.zero_grad()
        state, cost = problem.start([0]), torch.zeros(1)
        for action in actions:
            cost = cost + problem.cost(state, action)
            state = problem.dynamics(state, action)
        cost.sum().backward()
        return cost.sum()

    descent.step(total)
    torch.testing.assert_close(total().detach(), problem.lower_bound([0])[0], rtol=1e-3, atol=0.0)


@pytest.mark.parametrize(("name", "limit"), [("pendulum", 345.0), ("navigation", 50.0), ("lq", 110.0)])
def test_default_search_needs_no_settings(name, limit):
    """A plain cross-entropy method, which was the default, costs 350, 72 and 129."""
    problem, seeds = PROBLEMS[name], [0, 1, 2, 3]
    planner = CEMPlanner(
        action_dim=problem.action_dim,
        action_low=problem.action_low,
        action_high=problem.action_high,
        horizon=problem.horizon,
        num_samples=100,
        num_iterations=3,
    )
    streams = [torch.Generator().manual_seed(seed) for seed in seeds]
    controller = ModelPredictiveController(planner, problem.model(), generator=streams)
    assert problem.run(controller.act, seeds).mean() <= limit


@problems
def test_planner_costs_less_than_no_action_and_no_less_than_the_bound(problem):
    planner = CEMPlanner(
        action_dim=problem.action_dim,
        action_low=problem.action_low,
        action_high=problem.action_high,
        horizon=problem.horizon,
        num_samples=64,
        num_iterations=2,
    )
    seeds = [0, 1]
    controller = ModelPredictiveController(planner, problem.model(), generator=torch.Generator().manual_seed(0))
    planned = problem.run(controller.act, seeds)
    idle = problem.run(lambda state: torch.zeros(len(state), problem.action_dim), seeds)
    assert (planned < idle).all() and (planned >= problem.lower_bound(seeds)).all()
