"""Laws of plans and warm starts, for any options, problem and previous plan."""

import torch
from hypothesis import given
from hypothesis import strategies as st

from latentplan.planning import CEMPlanner, FunctionModel
from tests.planning.conftest import point_dynamics, point_policy, point_reward, point_value

BATCH, ACTIONS = 2, 2
MODELS = {
    "smooth": FunctionModel(point_dynamics, point_reward, value=point_value, policy=point_policy),
    "nan": FunctionModel(point_dynamics, lambda state, action: torch.full((len(state),), float("nan"))),
    "partly nan": FunctionModel(
        point_dynamics, lambda state, action: torch.where(action[:, 0] > 0.2, float("nan"), point_reward(state, action))
    ),
    "infinite": FunctionModel(
        point_dynamics, lambda state, action: torch.where(action[:, 0] > 0.0, float("inf"), -action[:, 1])
    ),
    "flat": FunctionModel(point_dynamics, lambda state, action: torch.zeros(len(state))),
    "huge": FunctionModel(point_dynamics, lambda state, action: 1e30 * action[:, 0]),
}


@st.composite
def planners(draw, **fixed):
    samples = draw(st.integers(2, 24))
    elites = draw(st.integers(1, samples))
    low = draw(st.lists(st.floats(-3.0, 0.5), min_size=ACTIONS, max_size=ACTIONS))
    width = draw(st.lists(st.floats(0.1, 3.0), min_size=ACTIONS, max_size=ACTIONS))
    options = {
        "horizon": draw(st.integers(1, 6)),
        "num_samples": samples,
        "num_elites": elites,
        "num_iterations": draw(st.integers(1, 3)),
        "smoothing": draw(st.floats(0.1, 1.0)),
        "init_std": draw(st.none() | st.floats(0.0, 10.0)),
        "min_std": draw(st.floats(0.0, 1.0)),
        "num_policy_samples": 0,
        "noise_beta": draw(st.sampled_from([0.0, 0.5, 2.0, 100.0])),
        "keep_elite_fraction": draw(st.sampled_from([0.0, 0.3, 1.0])),
        "temperature": draw(st.none() | st.floats(1e-3, 100.0)),
        "tail": draw(st.sampled_from(["zero", "hold"])),
        "final": draw(st.sampled_from(["mean", "best"])),
        "adapt_std": draw(st.booleans()),
        "discount": draw(st.floats(0.5, 1.0)),
        "action_low": low,
        "action_high": [start + size for start, size in zip(low, width, strict=True)],
    }
    return CEMPlanner(action_dim=ACTIONS, **options | fixed)


def seeded(seed):
    return [torch.Generator().manual_seed(seed + index) for index in range(BATCH)]


states = st.integers(0, 2**31 - 1).map(
    lambda seed: torch.randn(BATCH, 4, generator=torch.Generator().manual_seed(seed))
)
seeds = st.integers(0, 2**20)
models = st.sampled_from(sorted(MODELS))


def assert_within_bounds(planner, actions):
    low, high = torch.tensor(planner.action_low), torch.tensor(planner.action_high)
    assert torch.isfinite(actions).all()
    assert (actions >= low - 1e-6).all() and (actions <= high + 1e-6).all()


@given(planners(), models, states, seeds)
def test_plan_is_finite_and_within_the_bounds_cold_and_warm(planner, name, state, seed):
    plan = None
    for step in range(3):
        plan = planner.plan(MODELS[name], state, plan, generator=seeded(seed + step))
        assert plan.actions.shape == plan.mean.shape == plan.var.shape == (BATCH, planner.horizon, ACTIONS)
        assert_within_bounds(planner, plan.actions)
        assert torch.isfinite(plan.mean).all() and (plan.var >= 0.0).all()
        assert (torch.isfinite(plan.expected_return) | plan.info["is_fallback"]).all()
        if name == "nan":
            assert plan.info["is_fallback"].all() and (plan.info["num_nonfinite"] > 0).all()


@given(planners(), models, states, seeds)
def test_plan_depends_on_its_arguments_alone(planner, name, state, seed):
    first = planner.plan(MODELS[name], state, generator=seeded(seed))
    second = planner.plan(MODELS[name], state, generator=seeded(seed))
    again = [planner.plan(MODELS[name], state, plan, generator=seeded(seed + 9)) for plan in (first, second)]
    assert torch.equal(first.actions, second.actions) and torch.equal(again[0].actions, again[1].actions)


@given(planners(), states, seeds)
def test_plan_of_an_environment_does_not_depend_on_the_others(planner, state, seed):
    model = MODELS["smooth"]
    together = planner.plan(model, state, generator=seeded(seed))
    together = planner.plan(model, state, together, generator=seeded(seed + 5))
    for index in range(BATCH):
        own = [seeded(seed)[index]], [seeded(seed + 5)[index]]
        alone = planner.plan(model, state[index : index + 1], generator=own[0])
        alone = planner.plan(model, state[index : index + 1], alone, generator=own[1])
        torch.testing.assert_close(alone.actions[0], together.actions[index], rtol=1e-4, atol=1e-4)


@given(planners(keep_elite_fraction=0.0), states, seeds)
def test_warm_start_from_a_forgotten_plan_is_a_cold_start(planner, state, seed):
    model = MODELS["smooth"]
    last = planner.plan(model, state + 1.0, generator=seeded(seed))
    forgotten = planner.plan(model, state, last.forget(torch.ones(BATCH, dtype=torch.bool)), generator=seeded(seed + 5))
    cold = planner.plan(model, state, generator=seeded(seed + 5))
    torch.testing.assert_close(forgotten.actions, cold.actions)


@given(planners(init_std=0.0, min_std=0.0, temperature=None, final="mean"), states, seeds)
def test_warm_start_without_noise_continues_the_previous_plan(planner, state, seed):
    """Without spread, the samples are the shifted plan, whose end is filled as the option `tail` says."""
    model = MODELS["smooth"]
    wide = CEMPlanner(
        action_dim=ACTIONS,
        horizon=planner.horizon,
        num_policy_samples=0,
        num_samples=16,
        num_elites=4,
        keep_elite_fraction=0.0,
        final="mean",
        action_low=planner.action_low,
        action_high=planner.action_high,
    )
    last = wide.plan(model, state, generator=seeded(seed))
    plan = planner.plan(model, state, last, generator=seeded(seed))
    expected = last.mean[:, 1:]
    torch.testing.assert_close(plan.actions[:, :-1], expected, rtol=1e-4, atol=1e-5)
    low, high = torch.tensor(planner.action_low), torch.tensor(planner.action_high)
    end = (low + high) / 2.0 if planner.tail == "zero" else last.mean[:, -1]
    torch.testing.assert_close(plan.actions[:, -1], end.expand(BATCH, -1).clamp(low, high), rtol=1e-4, atol=1e-5)
