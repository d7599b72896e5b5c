"""Elites that stay candidates in the next iteration and in the next plan."""

import pytest
import torch

from latentplan.planning import FunctionModel


def test_final_best_return_is_at_least_that_of_every_elite(point, states, make_planner, seeded):
    plan = make_planner(final="best", keep_elite_fraction=1.0).plan(point, states, generator=seeded())
    torch.testing.assert_close(plan.actions, plan.elites[:, 0])
    assert (plan.expected_return >= plan.info["elite_return"][:, -1]).all()


@pytest.mark.parametrize("options", [{"keep_elite_fraction": 1.0}, {"final": "best"}])
def test_kept_elites_are_not_counted_twice(states, make_planner, seeded, options):
    """Proposals of the policy stay candidates anyway, and must not be counted twice either."""
    model = FunctionModel(
        lambda state, action: state + action[:, :1],
        lambda state, action: -action.square().sum(dim=1),  # the policy's small action is nearly optimal
        policy=lambda state, generator: torch.full((len(state), 2), 0.01),
    )
    planner = make_planner(num_policy_samples=1, num_iterations=4, num_elites=8, **options)
    plan = planner.plan(model, states, generator=seeded())
    if plan.elites is not None:
        for elites in plan.elites:
            assert len(torch.unique(elites.flatten(1), dim=0)) == len(elites)
    alone = make_planner(num_policy_samples=1, num_iterations=4, num_elites=8).plan(model, states, generator=seeded())
    if options == {"final": "best"}:  # the best candidate is a proposal, which stays anyway
        torch.testing.assert_close(plan.mean, alone.mean)


def test_kept_elites_are_dropped_when_the_plan_is_forgotten(point, states, make_planner, seeded):
    planner = make_planner(keep_elite_fraction=0.5)
    last = planner.plan(point, states + 5.0, generator=seeded())
    cold = planner.plan(point, states, last.forget(torch.ones(5, dtype=torch.bool)), generator=seeded(1))
    fresh = planner.plan(point, states, generator=seeded(1))
    torch.testing.assert_close(cold.mean, fresh.mean)


def test_shifted_elites_start_the_next_search(point, states, make_planner, seeded):
    last = make_planner(keep_elite_fraction=0.5).plan(point, states, generator=seeded())
    planner = make_planner(keep_elite_fraction=0.5, num_iterations=1, init_std=1e-6, final="best", tail="hold")
    plan = planner.plan(point, states, last, generator=seeded())
    shifted = torch.cat([last.elites[:, :, 1:], last.elites[:, :, -1:]], dim=2)
    distance = (plan.actions[:, None, :-1] - shifted[:, :, :-1]).abs().amax(dim=(2, 3)).amin(dim=1)
    assert (distance < 1e-4).any()
