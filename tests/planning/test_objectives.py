"""Arithmetic of objectives, risk measures, and constraints."""

import numpy as np
import pytest
import torch

from latentplan.planning import (
    FunctionModel,
    action_penalty,
    at_every_state,
    goal_term,
    learned_return,
    mppi_planner,
    rate_limit,
    risk,
    smoothness_penalty,
    terminal_value,
    uncertainty_penalty,
)
from latentplan.planning.search.scorer import Scorer


def score(model, objective, state, actions, *, discount=1.0, constraints=(), penalty=None):
    """Scores of actions (batch, sample, horizon, action) under an objective."""
    discounts = discount ** torch.arange(actions.shape[2] + 1.0)
    scorer = Scorer.build(
        model, objective, constraints, discounts, terminal_value=None, use_continues=False, penalty=penalty
    )
    return scorer.score(scorer.start_rows(state, actions.shape[1]), actions)


def returns(*arguments, **options):
    return score(*arguments, **options).returns


@pytest.fixture
def actions():
    return torch.rand(5, 7, 4, 2, generator=torch.Generator().manual_seed(1)) * 2 - 1


@pytest.fixture
def walk():
    """The action is the step: positions are sums of actions."""
    return FunctionModel(lambda state, action: state + action, lambda state, action: action[:, 0])


def test_terms_add_and_multiply(point, states, actions):
    reward, value = returns(point, learned_return(), states, actions), returns(point, terminal_value(), states, actions)
    size = returns(point, action_penalty(), states, actions)
    composed = 2 * learned_return() + terminal_value() * 0.5 - action_penalty() * 3 + 1.0
    torch.testing.assert_close(returns(point, composed, states, actions), 2 * reward + 0.5 * value - 3 * size + 1.0)
    torch.testing.assert_close(returns(point, learned_return() * terminal_value(), states, actions), reward * value)
    torch.testing.assert_close(returns(point, -learned_return(), states, actions), -reward)
    with_function = learned_return() + (lambda rollout: rollout.actions[:, 0, 0])
    torch.testing.assert_close(returns(point, with_function, states, actions), reward + actions[:, :, 0, 0])


@pytest.mark.parametrize("half", [0.5, np.float32(0.5), torch.tensor(0.5)])
def test_terms_multiply_with_any_kind_of_number(point, states, actions, half):
    expected = 0.5 * returns(point, learned_return(), states, actions)
    torch.testing.assert_close(returns(point, learned_return() * half, states, actions), expected)


def test_default_objective_is_reward_plus_value(point, states, actions):
    composed = learned_return() + terminal_value()
    torch.testing.assert_close(
        returns(point, None, states, actions, discount=0.9), returns(point, composed, states, actions, discount=0.9)
    )


def test_action_and_smoothness_penalty_equal_their_formulas(walk, actions):
    state = torch.zeros(5, 2)
    torch.testing.assert_close(returns(walk, action_penalty(), state, actions), -actions.square().sum(dim=(2, 3)))
    changes = (actions[:, :, 1:] - actions[:, :, :-1]).square().sum(dim=(2, 3))
    torch.testing.assert_close(returns(walk, smoothness_penalty(), state, actions), -changes)


def test_goal_term_measures_the_last_the_sum_or_the_closest_state(walk, actions):
    state, goal = torch.zeros(5, 2), torch.tensor([0.5, -1.0])
    distances = (actions.cumsum(dim=2) - goal).square().mean(dim=-1)
    for over, expected in [("last", distances[..., -1]), ("sum", distances.sum(-1)), ("min", distances.amin(-1))]:
        torch.testing.assert_close(returns(walk, goal_term(goal, over=over), state, actions), -expected)
    cosine = 1 - torch.cosine_similarity(actions.sum(dim=2), goal, dim=-1)
    torch.testing.assert_close(returns(walk, goal_term(goal, metric="cosine"), state, actions), -cosine)
    first = goal_term(goal[:1], select=lambda state: state[:, :1])
    torch.testing.assert_close(returns(walk, first, state, actions), -(actions.sum(dim=2)[..., 0] - 0.5).square())


def test_goal_term_takes_one_goal_per_environment(walk, make_planner, seeded):
    goals = torch.tensor([[1.5, 0.5], [-1.0, 2.0], [0.0, -2.0]])
    planner = make_planner(num_samples=256, num_iterations=8)
    plan = planner.plan(walk, torch.zeros(3, 2), objective=goal_term(goals), generator=seeded())
    torch.testing.assert_close(plan.actions.sum(dim=1), goals, atol=0.05, rtol=0)
    with pytest.raises(ValueError, match="goal must have shape"):
        planner.plan(walk, torch.zeros(2, 2), objective=goal_term(goals))


def test_uncertainty_penalty_uses_the_state_before_each_action(walk, actions):
    walk.uncertainty = lambda state, action: state.abs().sum(dim=1) + action.abs().sum(dim=1)
    positions = torch.cat([torch.zeros(5, 7, 1, 2), actions.cumsum(dim=2)[:, :, :-1]], dim=2)
    doubt = (positions.abs().sum(-1) + actions.abs().sum(-1)) * 0.9 ** torch.arange(4.0)
    measured = returns(walk, uncertainty_penalty(), torch.zeros(5, 2), actions, discount=0.9)
    torch.testing.assert_close(measured, -doubt.sum(dim=-1))


def test_plan_names_the_method_that_an_objective_needs(walk, states, make_planner):
    for objective, method in [(uncertainty_penalty(), "uncertainty"), (learned_return() + terminal_value(), "value")]:
        with pytest.raises(ValueError, match=method):
            make_planner().plan(walk, states[:, :2], objective=objective)


class Gamble:
    """The reward is the action times a slope that differs between the members of an ensemble: -3 or +1, 1 in 4 bad."""

    def step(self, state, action):
        return state, action[:, 0] * state[:, 0]

    def particles(self, state, num):
        slopes = torch.where(torch.arange(num) % 4 == 0, -3.0, 2.0)
        return slopes.repeat(len(state))[:, None]


def test_risk_averages_the_share_of_its_measure():
    actions = torch.tensor([-1.0, 0.5, 1.0]).reshape(1, 3, 1, 1).expand(2, 3, 1, 1)
    state = torch.zeros(2, 1)
    for measure, share, good, bad in [
        ("mean", 1.0, 0.75, -0.75),
        ("worst", 1.0, -3.0, -2.0),
        ("cvar", 0.5, -0.5, -2.0),
    ]:
        objective = risk(learned_return(), measure=measure, num_particles=8, worst_share=share)
        measured = returns(Gamble(), objective, state, actions)
        torch.testing.assert_close(measured, torch.tensor([[bad, good / 2, good]]).expand(2, 3))


def test_risk_mean_covers_all_particles_of_the_model():
    model = Gamble()
    model.num_particles = 8
    actions = torch.tensor([-1.0, 1.0]).reshape(1, 2, 1, 1)
    objective = risk(learned_return(), measure="mean", num_particles=1)
    torch.testing.assert_close(returns(model, objective, torch.zeros(1, 1), actions), torch.tensor([[-0.75, 0.75]]))


def test_risk_changes_the_plan_and_adds_to_other_terms(make_planner, seeded):
    mean, worst = (
        make_planner(horizon=1, action_dim=1).plan(
            Gamble(), torch.zeros(3, 1), objective=risk(learned_return(), measure=measure), generator=seeded()
        )
        for measure in ("mean", "worst")
    )
    assert (mean.action > 0.7).all() and (worst.action.abs() < 0.3).all()
    composed = risk(learned_return(), measure="mean") + 100 * action_penalty()
    careful = make_planner(horizon=1, action_dim=1).plan(
        Gamble(), torch.zeros(3, 1), objective=composed, generator=seeded()
    )
    assert (careful.action.abs() < 0.1).all()
    with pytest.raises(ValueError, match="num_particles"):
        risk(learned_return(), num_particles=4) + risk(learned_return(), num_particles=8)


def test_candidate_is_no_elite_when_one_particle_is_nan(make_planner, seeded):
    class Breaks(Gamble):
        def step(self, state, action):
            return state, torch.where((action[:, 0] > 0) & (state[:, 0] < 0), float("nan"), action[:, 0])

    objective = risk(learned_return(), measure="cvar")
    plan = make_planner(horizon=1, action_dim=1, final="best").plan(
        Breaks(), torch.zeros(2, 1), objective=objective, generator=seeded()
    )
    assert (plan.action <= 0).all()


def test_proposals_are_scored_over_all_particles(seeded, make_planner):
    class WithPolicy(Gamble):
        def policy(self, state, generator):
            return torch.ones(len(state), 1)

    objective = risk(learned_return(), measure="worst")
    plan = make_planner(horizon=1, action_dim=1, num_policy_samples=20, final="best").plan(
        WithPolicy(), torch.full((2, 1), 2.0), objective=objective, generator=seeded()
    )
    assert (plan.action.abs() < 0.3).all()  # with the start's own slope the policy's action would earn 2


def wall(rollout):
    """Positions above 0.5 are infeasible; the violation is the distance beyond 0.5."""
    return torch.stack([state[:, 0] for state in rollout.states]).amax(dim=0) - 0.5


@pytest.mark.parametrize("make", ["cem", "mppi"])
def test_constraints_are_satisfied_and_the_return_maximised(walk, make_planner, seeded, make):
    settings = {"num_samples": 400, "num_elites": 20, "num_iterations": 6, "horizon": 3}
    planner = make_planner(**settings)
    if make == "mppi":
        planner = mppi_planner(action_dim=2, temperature=0.02, **settings | {"num_elites": 400})
    free = planner.plan(walk, torch.zeros(3, 2), generator=seeded())
    kept = planner.plan(walk, torch.zeros(3, 2), constraints=[wall], generator=seeded())
    assert (free.actions[..., 0].sum(dim=1) > 1.0).all()
    reached = kept.actions[..., 0].cumsum(dim=1)
    assert (reached <= 0.5 + 1e-6).all() and (kept.info["violation"] == 0).all()
    assert (reached[:, -1] > 0.3).all()


def test_constraint_penalty_trades_violation_for_return(walk, make_planner, seeded):
    settings = {"num_samples": 400, "num_elites": 20, "num_iterations": 6, "horizon": 3}
    cheap, dear = (
        make_planner(constraint_penalty=penalty, **settings).plan(
            walk, torch.zeros(2, 2), constraints=[wall], generator=seeded()
        )
        for penalty in (0.1, 50.0)
    )
    assert (cheap.info["violation"] > 0.5).all() and (dear.info["violation"] < 0.1).all()
    torch.testing.assert_close(cheap.info["violation"], wall_violation(cheap))


def wall_violation(plan):
    return (plan.actions[..., 0].cumsum(dim=1).amax(dim=1) - 0.5).clamp_min(0)


def test_least_infeasible_candidate_is_chosen_when_none_is_feasible(walk, make_planner, seeded):
    plan = make_planner(num_samples=400, num_iterations=6, horizon=3).plan(
        walk, torch.tensor([[4.0, 0.0]]), constraints=[wall], generator=seeded()
    )
    assert plan.action[0, 0] < -0.95
    assert plan.info["violation"].item() == pytest.approx(4.0 + plan.actions[0, 0, 0].item() - 0.5, abs=1e-4)


def test_best_candidate_is_executed_when_the_mean_violates_a_constraint(make_planner, seeded):
    """Feasible actions lie on both sides of an infeasible middle, so their mean is infeasible."""
    model = FunctionModel(lambda state, action: state, lambda state, action: -action[:, 1].square())
    planner = make_planner(horizon=1, num_samples=400, num_elites=200, num_iterations=1)
    middle = planner.plan(
        model, torch.zeros(1, 1), constraints=[lambda rollout: 0.4 - rollout.actions[:, 0, 0].abs()], generator=seeded()
    )
    assert middle.mean[0, 0, 0].abs() < 0.4
    assert (middle.actions[:, 0, 0].abs() >= 0.4).all() and (middle.info["violation"] == 0).all()


def test_candidate_is_infeasible_when_its_violation_is_nan(walk, make_planner, seeded):
    plan = make_planner(horizon=1, final="best").plan(
        walk,
        torch.zeros(2, 2),
        constraints=[lambda rollout: torch.where(rollout.actions[:, 0, 0] > 0, float("nan"), 0.0)],
        generator=seeded(),
    )
    assert (plan.action[:, 0] <= 0).all()


@pytest.mark.parametrize("penalty", [None, 1.0])
def test_search_counts_and_warns_of_violations_that_are_nan(walk, make_planner, seeded, penalty):
    constraint = at_every_state(lambda state: torch.where(state[:, 1] > 5, state[:, 0] * float("nan"), 0.0))
    plan = make_planner(constraint_penalty=penalty).plan(
        walk, torch.tensor([[0.0, 0.0], [0.0, 99.0]]), constraints=[constraint], generator=seeded(), keep="candidates"
    )
    assert plan.info["num_nonfinite"].tolist() == [0, 3 * 64] and plan.info["is_fallback"].tolist() == [False, True]
    assert not any(iteration.is_feasible[1].any() for iteration in plan.candidates)
    with pytest.warns(RuntimeWarning, match="nothing finite"):
        plan.warn_of_failures()


def test_at_every_state_sums_the_excess_over_the_steps(walk, actions):
    constraint = at_every_state(lambda state: state[:, 0] - 0.5)
    excess = (actions.cumsum(dim=2)[..., 0] - 0.5).clamp_min(0).sum(dim=2)
    scores = score(walk, None, torch.zeros(5, 2), actions, constraints=[constraint])
    torch.testing.assert_close(scores.violations, excess)
    penalised = score(walk, None, torch.zeros(5, 2), actions, constraints=[constraint], penalty=2.0)
    torch.testing.assert_close(penalised.returns, scores.returns - 2 * excess)


def test_goal_term_and_risk_name_a_bad_argument():
    with pytest.raises(ValueError, match="metric"):
        goal_term(torch.zeros(2), metric="l1")
    with pytest.raises(ValueError, match="num_particles must be a whole number"):
        risk(learned_return(), num_particles=2.5)
    with pytest.raises(ValueError, match="a rate limit must be above 0"):
        rate_limit([])
    with pytest.raises(ValueError, match="measure"):
        risk(learned_return(), measure="best")
    with pytest.raises(ValueError, match="goal"):
        goal_term(torch.zeros(2, 2, 2))
    with pytest.raises(ValueError, match=r"a goal is a tensor .*, got list"):
        goal_term([0.0, 0.0])


def test_terms_are_subtracted_from_and_divided_by_numbers(walk, actions):
    size = returns(walk, action_penalty(), torch.zeros(5, 2), actions)
    torch.testing.assert_close(returns(walk, 1 - action_penalty(), torch.zeros(5, 2), actions), 1 - size)
    torch.testing.assert_close(returns(walk, action_penalty() / 2, torch.zeros(5, 2), actions), size / 2)


def test_constraint_sets_the_number_of_particles(make_planner, seeded):
    seen = []

    def watch(rollout):
        seen.append(rollout.num_particles)
        return torch.zeros(len(rollout.actions))

    make_planner().plan(Gamble(), torch.zeros(1, 1), constraints=[risk(watch, num_particles=4)], generator=seeded())
    assert set(seen) == {4}


def test_plan_names_terms_of_a_wrong_kind(walk, make_planner):
    def refuses(message, **goals):
        with pytest.raises((TypeError, ValueError), match=message):
            make_planner().plan(walk, torch.zeros(1, 2), **goals)

    refuses("the objective must be a tensor of shape .64,., got float", objective=lambda rollout: 1.0)
    refuses("the objective must be a tensor of shape .64,., got NoneType", objective=lambda rollout: None)
    refuses("the objective must be .*, got ndarray", objective=lambda rollout: rollout.rewards.sum(1).numpy())
    refuses("the objective of risk.. must be .*, got float", objective=risk(lambda rollout: 1.0, num_particles=2))
    refuses("objective must be a function of rollouts, got 'height > 1'; only an agent's", objective="height > 1")
    refuses("a constraint must be .*, got int", constraints=[lambda rollout: 0])
    refuses("constraints must be a sequence of functions.*, got one function", constraints=rate_limit(0.1))
    refuses("constraints must be a sequence of functions.*, got 'cart < 1'", constraints="cart < 1")
    refuses("constraints must be a sequence of functions.*, got None", constraints=None)
    for function, got in ((lambda state: state, ".64, 2."), (torch.max, "..")):
        refuses(f"at_every_state.. must have shape .64,., got {got}", constraints=[at_every_state(function)])
    refuses("at_every_state.. must be .*, got float", constraints=[at_every_state(lambda state: 0.0)])
    for select, got in ((lambda state: state[:, 0], "shape .64,."), (lambda state: (state,), "tuple")):
        goal = goal_term(torch.zeros(2), select=select)
        refuses(f"goal_term.. compares features .rows, feature., which select returns, got {got}", objective=goal)


def test_uncertainty_of_a_wrong_kind_is_named(walk, make_planner):
    walk.uncertainty = lambda state, action: 0.0
    with pytest.raises(TypeError, match="uncertainty.. must be a tensor of shape .64,., got float"):
        make_planner().plan(walk, torch.zeros(1, 2), objective=uncertainty_penalty())
