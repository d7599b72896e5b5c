"""A plan depends on its own environment, random stream and model only."""

from typing import NamedTuple

import pytest
import torch

from latentplan.planning import FunctionModel


def assert_same_plan(left, right):
    # 1e-5: rows of a matrix product may be summed in another order when more rows share it.
    torch.testing.assert_close(left.mean, right.mean, atol=1e-5, rtol=0)
    torch.testing.assert_close(left.var, right.var, atol=1e-5, rtol=0)
    torch.testing.assert_close(left.expected_return, right.expected_return, atol=1e-4, rtol=1e-5)


def pick(plan, index):
    return type(plan)(
        plan.actions[index],
        plan.mean[index],
        plan.var[index],
        plan.expected_return[index],
        {},
        None if plan.elites is None else plan.elites[index],
        plan.is_warm[index],
        plan.elapsed[index],
    )


RICH = {"num_policy_samples": 6, "keep_elite_fraction": 0.3, "noise_beta": 1.0, "tail": "policy"}


@pytest.mark.parametrize("options", [{}, RICH])
def test_plan_is_the_same_alone_and_with_other_environments(point, states, make_planner, seeded, options):
    planner = make_planner(**options)
    together = planner.plan(point, states, generator=seeded())
    warm = planner.plan(point, states + 0.1, together.forget(torch.tensor([0, 1, 0, 0, 1]).bool()), generator=seeded(1))
    for index in range(len(states)):
        row = slice(index, index + 1)
        alone = planner.plan(point, states[row], generator=seeded())
        assert_same_plan(alone, pick(together, row))
        before = alone.forget(torch.tensor([index in (1, 4)]))
        assert_same_plan(planner.plan(point, states[row] + 0.1, before, generator=seeded(1)), pick(warm, row))


def test_plan_is_the_same_among_64_environments(point, make_planner, seeded):
    many = torch.randn(64, 4, generator=seeded(9))
    planner = make_planner(num_policy_samples=4)
    together = planner.plan(point, many, generator=seeded())
    for index in (0, 17, 63):
        row = slice(index, index + 1)
        assert_same_plan(planner.plan(point, many[row], generator=seeded()), pick(together, row))


def test_plan_is_the_same_in_another_order_of_environments(point, states, make_planner, seeded):
    planner, order = make_planner(num_policy_samples=4), torch.tensor([3, 0, 4, 2, 1])
    plan = planner.plan(point, states, generator=seeded())
    assert_same_plan(planner.plan(point, states[order], generator=seeded()), pick(plan, order))


def test_list_of_generators_gives_each_environment_its_own_stream(point, states, make_planner, seeded):
    planner = make_planner(num_policy_samples=4)
    plan = planner.plan(point, states, generator=[seeded(seed) for seed in range(5)])
    alone = planner.plan(point, states[3:4], generator=seeded(3))
    assert_same_plan(alone, pick(plan, slice(3, 4)))
    with pytest.raises(ValueError, match="one for each of 5"):
        planner.plan(point, states, generator=[seeded()])


def test_plan_is_the_same_when_another_environment_starts_cold(point, states, make_planner, seeded):
    planner = make_planner(num_iterations=4, warm_start_iterations=2)
    pair, single = seeded(5), seeded(5)
    both = planner.plan(point, states[:2], generator=pair)
    both = planner.plan(point, states[:2], both.forget(torch.tensor([False, True])), generator=pair)
    assert both.info["iterations"].tolist() == [2, 4]
    both = planner.plan(point, states[:2], both, generator=pair)
    one = None
    for _ in range(3):
        one = planner.plan(point, states[:1], one, generator=single)
    assert_same_plan(one, pick(both, slice(0, 1)))


def test_plan_depends_on_the_seed(point, states, make_planner, seeded):
    planner = make_planner()
    first, again, other = (planner.plan(point, states, generator=seeded(seed)) for seed in (0, 0, 1))
    assert torch.equal(first.mean, again.mean)
    assert not torch.equal(first.mean, other.mean)


def test_plan_is_the_same_when_another_environment_is_nan(point, states, make_planner, seeded):
    planner = make_planner()
    spoiled = states.clone()
    spoiled[2] = float("nan")
    plan, good = planner.plan(point, spoiled, generator=seeded()), planner.plan(point, states, generator=seeded())
    assert plan.info["is_fallback"].tolist() == [False, False, True, False, False]
    others = torch.tensor([0, 1, 3, 4])
    assert_same_plan(pick(plan, others), pick(good, others))


def test_fused_rollout_gives_the_same_plan_as_steps(point, states, make_planner, seeded):
    def rollout(state, actions):
        rewards = []
        for action in actions.unbind(1):
            rewards.append(point.reward(state, action))
            state = point.dynamics(state, action)
        return torch.stack(rewards, dim=1), state

    fused = FunctionModel(point.dynamics, point.reward, value=point.value, rollout=rollout)
    stepped = FunctionModel(point.dynamics, point.reward, value=point.value)
    plans = [make_planner().plan(model, states, generator=seeded()) for model in (fused, stepped)]
    assert_same_plan(*plans)


class Nested(NamedTuple):
    position: torch.Tensor
    rest: dict


def test_plan_is_the_same_when_the_state_is_nested(point, states, make_planner, seeded):
    def flat(state):
        return torch.cat([state.position, state.rest["velocity"]], dim=1)

    def nest(state):
        return Nested(state[:, :2], {"velocity": state[:, 2:]})

    nested = FunctionModel(
        lambda state, action: nest(point.dynamics(flat(state), action)),
        lambda state, action: point.reward(flat(state), action),
        value=lambda state: point.value(flat(state)),
        policy=lambda state, generator: point.policy(flat(state), generator),
    )
    planner = make_planner(num_policy_samples=3)
    left, right = (
        planner.plan(nested, nest(states), generator=seeded()),
        planner.plan(point, states, generator=seeded()),
    )
    assert_same_plan(left, right)
