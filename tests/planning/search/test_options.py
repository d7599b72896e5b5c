"""Every option of the search does what it says."""

import dataclasses

import pytest
import torch

from latentplan.config import PlannerConfig
from latentplan.planning import (
    PLANNERS,
    CEMPlanner,
    FunctionModel,
    SearchOptions,
    icem_planner,
    learned_return,
    mppi_planner,
    refit,
)
from latentplan.planning.search.sampling import Streams


class Recorder:
    """A model whose state stays, and that keeps the candidates of every iteration."""

    def __init__(self):
        self.candidates = []

    def step(self, state, action):
        raise NotImplementedError("only whole sequences are imagined")

    def rollout(self, state, actions):
        self.candidates.append(actions.clone())
        return -(actions - 0.3).square().sum(dim=2), state


@pytest.fixture
def recorder():
    return Recorder()


def frozen(make_planner, **options):
    """A planner that samples only its start: the plan is where the search began."""
    return make_planner(init_std=0.0, num_iterations=1, **options)


def test_planner_config_and_planner_share_options_defaults_and_checks():
    evaluated = {
        "num_elites": 16,
        "final": "mean",
        "policy_margin": 0.01,
        "noise_beta": 0.0,
        "keep_elite_fraction": 0.0,
        "use_continues": None,
    }
    problem = {"action_dim", "action_low", "action_high", "action_choices", "init_mean", "discount", "clock"}
    for kind, own, other in ((PlannerConfig, {"method", "surprise_limit"}, evaluated), (CEMPlanner, problem, {})):
        fields = {field.name: field.default for field in dataclasses.fields(kind)}
        shared = {field.name: field.default for field in dataclasses.fields(SearchOptions)}
        assert fields.keys() - own == shared.keys()
        assert {name: fields[name] for name in shared} == shared | other
    for bad in (
        {"num_elites": 129},
        {"smoothing": 0.0},
        {"tail": "head"},
        {"temperature": -1.0},
        {"policy_margin": -1.0},
    ):
        messages = []
        for make in (lambda bad=bad: PlannerConfig(**bad), lambda bad=bad: CEMPlanner(action_dim=1, **bad)):
            with pytest.raises(ValueError, match=next(iter(bad))) as caught:
                make()
            messages.append(str(caught.value))
        assert messages[0] == messages[1]


def test_sizes_set_the_number_of_candidates_iterations_and_steps(make_planner, recorder):
    make_planner(horizon=5, num_samples=50, num_iterations=2).plan(recorder, torch.zeros(1, 4))
    assert [tuple(each.shape) for each in recorder.candidates] == [(50, 5, 2)] * 2


def test_num_elites_sets_how_many_candidates_refit_the_mean(make_planner, recorder):
    plan = make_planner(num_elites=5, num_iterations=1, smoothing=1.0).plan(recorder, torch.zeros(1, 4))
    candidates = recorder.candidates[0]
    best = (-(candidates - 0.3).square().sum(dim=(1, 2))).topk(5).indices
    torch.testing.assert_close(plan.mean[0], candidates[best].mean(dim=0))


def test_smoothing_weighs_the_new_statistics(point, states, make_planner, seeded):
    full, half = (
        make_planner(num_iterations=1, smoothing=smoothing).plan(point, states, generator=seeded())
        for smoothing in (1.0, 0.5)
    )
    torch.testing.assert_close(half.mean, full.mean / 2)
    torch.testing.assert_close(half.var, (full.var + 1.0) / 2)


def test_adapt_std_refits_the_variance(point, states, make_planner, seeded):
    fixed, fitted = (make_planner(adapt_std=adapt).plan(point, states, generator=seeded()) for adapt in (False, True))
    assert (fixed.var == 1.0).all() and (fitted.var < 0.5).any()


def test_num_policy_samples_replaces_that_many_samples_by_proposals(make_planner, recorder, seeded):
    recorder.propose = lambda state, num, horizon, generators: torch.full((num, horizon, 2), 0.625)
    recorder.policy = lambda state, generator: torch.full((len(state), 2), 0.625)
    for asked, expected in ((None, 16), (5, 5), (0, 0)):  # None: a quarter of 64 candidates
        make_planner(num_policy_samples=asked, num_iterations=1).plan(recorder, torch.zeros(1, 4), generator=seeded())
        is_proposal = (recorder.candidates[-1] == 0.625).flatten(1).all(dim=1)
        assert len(is_proposal) == 64 and is_proposal.sum() == expected
    del recorder.policy
    make_planner(num_policy_samples=None).plan(recorder, torch.zeros(1, 4), generator=seeded())


def test_num_policy_samples_is_24_by_default_when_there_are_enough_candidates():
    assert SearchOptions().num_proposals(has_policy=True) == 24
    assert SearchOptions().num_proposals(has_policy=False) == 0


def test_warm_start_iterations_are_half_of_the_cold_ones_by_default(make_planner, point, states, seeded):
    assert [SearchOptions(num_iterations=num).num_warm_iterations for num in (1, 3, 4)] == [1, 2, 2]
    planner = make_planner(num_iterations=5, warm_start_iterations=None)
    last = planner.plan(point, states, generator=seeded())
    assert last.info["iterations"].tolist() == [5] * 5
    assert planner.plan(point, states, last, generator=seeded()).info["iterations"].tolist() == [3] * 5


def test_warm_start_false_ignores_the_last_plan(point, states, make_planner, seeded):
    last = make_planner().plan(point, states, generator=seeded())
    cold = make_planner(warm_start=False).plan(point, states, last, generator=seeded(1))
    assert torch.equal(cold.mean, make_planner().plan(point, states, generator=seeded(1)).mean)


def test_goal_horizon_sets_the_length_of_plans_for_objectives_only(point, states, make_planner, seeded):
    planner = make_planner(goal_horizon=9)
    own = planner.plan(point, states, generator=seeded())
    assert torch.equal(own.mean, make_planner().plan(point, states, generator=seeded()).mean)
    assert planner.plan(point, states, objective=learned_return(), generator=seeded()).actions.shape[1] == 9


@pytest.mark.parametrize(
    ("tail", "expected"),
    [("zero", 0.0), ("hold", "last"), ("policy", "policy")],
)
def test_tail_fills_the_end_of_the_shifted_plan(point, states, make_planner, seeded, tail, expected):
    last = make_planner().plan(point, states, generator=seeded())
    plan = frozen(make_planner, tail=tail).plan(point, states, last, generator=seeded())
    torch.testing.assert_close(plan.mean[:, :-1], last.actions[:, 1:])
    end = plan.mean[:, -1]
    if expected == "last":
        torch.testing.assert_close(end, last.actions[:, -1])
    elif expected == "policy":
        state = states
        for action in last.actions[:, 1:].unbind(1):
            state = point.dynamics(state, action)
        torch.testing.assert_close(end, point.policy(state, None).clamp(-1, 1))
    else:
        assert (end == 0).all()


def test_warm_start_resets_the_variance(point, states, make_planner, seeded):
    last = make_planner().plan(point, states, generator=seeded())
    plan = make_planner(num_iterations=1, smoothing=1e-9).plan(point, states, last, generator=seeded())
    torch.testing.assert_close(plan.var, torch.ones_like(plan.var))


def test_policy_is_not_called_when_num_policy_samples_is_0(point, states, make_planner, seeded):
    def forbidden(state, generator):
        raise AssertionError("the policy was called")

    model = FunctionModel(point.dynamics, point.reward, policy=forbidden)
    make_planner(num_policy_samples=0, final="better").plan(model, states, generator=seeded())


def test_warm_and_cold_environments_have_their_own_iterations(point, states, make_planner, seeded):
    planner = make_planner(num_iterations=5, warm_start_iterations=2)
    last = planner.plan(point, states, generator=seeded()).forget(torch.tensor([1, 0, 0, 1, 0]).bool())
    assert planner.plan(point, states, last, generator=seeded()).info["iterations"].tolist() == [5, 2, 2, 5, 2]


@pytest.mark.parametrize("beta", [0.0, 1.0, 3.0])
def test_coloured_noise_has_unit_variance_and_correlated_steps(beta):
    streams = Streams(torch.Generator().manual_seed(0), 1, torch.device("cpu"))
    noise = streams.noise(20_000, 12, 1, beta, 0.0, torch.float64)[0][0, :, :, 0]
    torch.testing.assert_close(noise.var(dim=0), torch.ones(12, dtype=torch.float64), atol=0.05, rtol=0)
    neighbours = (noise[:, 1:] * noise[:, :-1]).mean().item()
    opposite_ends = (noise[:, 0] * noise[:, -1]).mean().item()
    assert neighbours == pytest.approx({0.0: 0.0, 1.0: 0.42, 3.0: 0.9}[beta], abs=0.15)
    assert opposite_ends < neighbours + 0.02  # the end of a sequence is not tied to its start


def test_mppi_equals_its_formula(point, states, seeded):
    options = {"temperature": 0.5, "init_std": 0.4, "noise_beta": 0.0, "final": "mean"}
    planner = mppi_planner(action_dim=2, horizon=4, num_samples=128, num_policy_samples=0, **options)
    plan = planner.plan(point, states[:1], generator=seeded())
    streams = Streams(seeded(), 1, torch.device("cpu"))
    candidates = (0.4 * streams.noise(128, 4, 2, 0.0, 0.0, torch.float32)[0][0]).clamp(-1, 1)
    candidates[0] = 0.0
    returns = []
    for sequence in candidates:
        state, total = states[:1], 0.0
        for action in sequence:
            total = total + point.reward(state, action[None])
            state = point.dynamics(state, action[None])
        returns.append(total + point.value(state))
    returns = torch.cat(returns)
    weights = torch.softmax(returns / (0.5 * returns.std(correction=0)), dim=0)
    torch.testing.assert_close(plan.mean[0], torch.einsum("s,sha->ha", weights, candidates), atol=1e-4, rtol=0)
    torch.testing.assert_close(plan.var, torch.full_like(plan.var, 0.16))


def test_mppi_plans_the_same_when_returns_are_scaled_and_shifted(point, states, seeded):
    scaled = FunctionModel(point.dynamics, lambda state, action: 1000 * point.reward(state, action) - 7)
    bare = FunctionModel(point.dynamics, point.reward)
    planner = mppi_planner(action_dim=2, horizon=4, num_samples=64, num_iterations=2)
    plans = [planner.plan(model, states, generator=seeded()) for model in (bare, scaled)]
    torch.testing.assert_close(plans[0].mean, plans[1].mean, atol=1e-4, rtol=1e-4)


def test_mppi_weighs_equal_returns_alike(seeded):
    model = FunctionModel(lambda state, action: state, lambda state, action: torch.full((len(state),), -1.0))
    planner = mppi_planner(action_dim=2, horizon=4, num_samples=64, final="mean")
    seen = []
    plan = planner.plan(model, torch.zeros(2, 1), generator=seeded(), callback=seen.append)
    assert not plan.info["is_fallback"].any()
    torch.testing.assert_close(plan.mean, seen[0].actions.mean(dim=1))
    torch.testing.assert_close(plan.expected_return, torch.full((2,), -4.0))


def test_mixed_noise_has_smooth_samples_that_explore_and_white_ones_that_stay_close():
    streams = Streams(torch.Generator().manual_seed(0), 1, torch.device("cpu"))
    noise, scale = streams.noise(40_000, 10, 1, 2.0, 0.5, torch.float64)
    torch.testing.assert_close(noise.var(dim=(0, 1, 3)), torch.ones(10, dtype=torch.float64), atol=0.03, rtol=0)
    smooth, white = (noise * scale)[0, :, :, 0].chunk(2)
    assert smooth.std().item() == pytest.approx(1.25, abs=0.03) and white.std().item() == pytest.approx(0.5, abs=0.01)
    correlation = [(part[:, 1:] * part[:, :-1]).mean().item() / part.var().item() for part in (smooth, white)]
    assert correlation[0] > 0.6 and abs(correlation[1]) < 0.02


def test_lower_temperature_raises_the_expected_return(point, states, seeded):
    values = [
        mppi_planner(action_dim=2, horizon=4, final="mean", temperature=temperature).plan(
            point, states, generator=seeded()
        )
        for temperature in (0.1, 1.0, 10.0)
    ]
    returns = torch.stack([plan.expected_return for plan in values])
    assert (returns[0] > returns[1]).all() and (returns[1] > returns[2]).all()


def test_icem_beats_plain_cem_on_a_sluggish_system(seeded):
    """Slow dynamics need sustained actions, which white noise averages away."""

    def dynamics(state, action):
        return torch.cat([state[:, :1] + 0.05 * state[:, 1:], state[:, 1:] + 0.05 * action], dim=1)

    model = FunctionModel(dynamics, lambda state, action: state[:, 0] - 0.0 * action[:, 0])
    settings = {"action_dim": 1, "horizon": 25, "num_samples": 48, "num_elites": 6, "num_iterations": 2}
    white = {"noise_beta": 0.0, "keep_elite_fraction": 0.0, "final": "best", "smoothing": 1.0}
    plain = CEMPlanner(**settings | white)
    better = 0
    for seed in range(5):
        start = torch.zeros(1, 2)
        icem_return = icem_planner(**settings).plan(model, start, generator=seeded(seed)).expected_return
        better += int(icem_return > plain.plan(model, start, generator=seeded(seed)).expected_return)
    assert better >= 4


def test_gradient_steps_raise_returns_and_lower_none(point, states, make_planner, seeded):
    def true_return(plan):
        state, total = states, 0.0
        for action in plan.actions.unbind(1):
            total = total + point.reward(state, action)
            state = point.dynamics(state, action)
        return total + point.value(state)

    plain, refined = (make_planner(gradient_steps=n).plan(point, states, generator=seeded()) for n in (0, 10))
    gain = true_return(refined) - true_return(plain)
    assert (gain >= -1e-5).all() and (gain > 0.01).any()
    torch.testing.assert_close(refined.expected_return, true_return(refined))
    tiny = make_planner(gradient_steps=10, gradient_step_size=1e-4).plan(point, states, generator=seeded())
    assert (tiny.actions - plain.actions).abs().max() < 2e-3 < (refined.actions - plain.actions).abs().max()


def test_gradient_steps_that_overshoot_are_halved(make_planner, seeded):
    """The optimum is a narrow ridge at 0.37; the first step of 0.5 jumps over it."""
    model = FunctionModel(lambda state, action: state, lambda state, action: -(action - 0.37).abs().sum(dim=1))
    planner = make_planner(init_std=0.0, horizon=1, gradient_steps=25, gradient_step_size=0.5)
    plan = planner.plan(model, torch.zeros(1, 1), generator=seeded())
    torch.testing.assert_close(plan.action, torch.full((1, 2), 0.37), atol=1e-3, rtol=0)


def test_gradient_steps_work_in_inference_mode_and_refuse_models_without_gradients(point, states, make_planner, seeded):
    planner = make_planner(gradient_steps=2)
    with torch.inference_mode():
        inside = planner.plan(point, states + 0.0, generator=seeded())
    torch.testing.assert_close(inside.actions, planner.plan(point, states, generator=seeded()).actions)
    blind = FunctionModel(point.dynamics, lambda state, action: torch.ones(len(state)))
    with pytest.raises(ValueError, match="differentiable"):
        planner.plan(blind, states, generator=seeded())


def test_planner_iteration_equals_refit_of_its_candidates(seeded):
    seen = []

    def reward(state, action):
        seen.append(action.clone())
        return -(action - 0.3).square().sum(dim=1)

    model = FunctionModel(lambda state, action: state, reward)
    planner = mppi_planner(
        action_dim=2, horizon=1, num_samples=32, num_elites=4, temperature=None, smoothing=0.7, adapt_std=True
    )
    plan = planner.plan(model, torch.zeros(1, 1), generator=seeded())
    candidates = seen[0][:, None]
    returns = -(seen[0] - 0.3).square().sum(dim=1)
    mean, var = refit(candidates, returns, torch.zeros(1, 2), torch.full((1, 2), 0.25), num_elites=4, smoothing=0.7)
    torch.testing.assert_close((plan.mean[0], plan.var[0]), (mean, var))


def test_actions_stay_within_bounds_when_rounded(seeded):
    options = {"final": "best", "num_iterations": 6, "temperature": 1.0, "smoothing": 1.0}
    planner = CEMPlanner(
        action_dim=1, horizon=3, num_samples=100, num_elites=10, action_low=1.2, action_high=1.7, **options
    )
    model = FunctionModel(lambda state, action: state, lambda state, action: -action[:, 0])
    for seed in range(5):
        plan = planner.plan(model, torch.zeros(1, 1), generator=seeded(seed))
        assert plan.actions.min() >= torch.tensor(1.2) and plan.actions.max() <= torch.tensor(1.7)


def test_gradient_steps_refuse_a_return_that_the_action_does_not_reach(make_planner):
    embedding = torch.nn.Embedding(3, 1)

    def reward(state, action):
        return embedding(action[:, 0].long().clamp(0, 2))[:, 0]

    model = FunctionModel(lambda state, action: state, reward)
    with pytest.raises(ValueError, match="differentiable in the action"):
        make_planner(gradient_steps=2).plan(model, torch.zeros(2, 1))


def test_gradient_steps_keep_the_result_when_refinement_is_nan(seeded):
    model = FunctionModel(
        lambda state, action: state,
        lambda state, action: torch.where((action[:, 0] > 0.5) | (action[:, 0] < -0.5), action[:, 0].abs(), torch.nan),
    )
    planner = CEMPlanner(action_dim=1, horizon=1, num_samples=64, num_elites=32, num_iterations=1, gradient_steps=2)
    plan = planner.plan(model, torch.zeros(1, 1), generator=seeded(0))
    assert not plan.failures().any() and torch.isfinite(plan.expected_return).all()


@pytest.mark.parametrize("name", ["horizon", "num_samples", "action_dim"])
def test_planner_refuses_sizes_that_are_not_whole(name):
    sizes = {"action_dim": 2, "horizon": 3, "num_samples": 16, "num_elites": 4}
    with pytest.raises(ValueError, match=f"{name} must be a whole number"):
        CEMPlanner(**sizes | {name: float(sizes[name])})


def test_plan_refuses_a_state_without_rows(point, make_planner):
    with pytest.raises(ValueError, match="at least one row"):
        make_planner().plan(point, torch.zeros(0, 4))


def counted(point, curvature=1.0):
    """A model that counts its steps with a gradient; only 0.3 is good, as sharply as `curvature` says."""
    calls = []

    def reward(state, action):
        if torch.is_grad_enabled():
            calls.append(len(action))
        return -curvature * (action - 0.3).square().sum(dim=1)

    return FunctionModel(lambda state, action: state, reward), calls


def test_gradient_pauses_where_it_does_not_help_and_tries_again(point, make_planner, seeded):
    """A plateau has no gradient: the refinement pauses for 1, 3, 7 and 15 searches, then for 15 again."""
    model, calls = counted(point, curvature=0.0)
    planner = make_planner(gradient_steps=2, horizon=1, num_iterations=1)
    plan, refined = None, []
    for search in range(48):
        calls.clear()
        plan = planner.plan(model, torch.zeros(2, 1), plan, generator=seeded(search))
        refined += [search] if calls else []
    assert refined == [0, 2, 6, 14, 30, 46]


def test_gradient_goes_on_where_it_helps_and_after_a_cold_start(point, make_planner, seeded):
    model, calls = counted(point)
    planner = make_planner(gradient_steps=2, num_iterations=1)
    plan = None
    for search in range(6):
        calls.clear()
        plan = planner.plan(model, torch.zeros(2, 1), plan, generator=seeded(search))
        assert calls and plan.info["gradient_wait"].tolist() == [0, 0]
    flat, calls = counted(point, curvature=0.0)
    plan = planner.plan(flat, torch.zeros(2, 1), plan, generator=seeded())
    assert plan.info["gradient_wait"].tolist() == [1, 1]
    calls.clear()
    planner.plan(flat, torch.zeros(2, 1), plan.forget(torch.tensor([True, False])), generator=seeded())
    assert calls  # an environment that starts cold has no pause


@pytest.mark.parametrize("gradient_steps", [5, 20])
def test_gradient_of_an_environment_does_not_depend_on_the_others(seeded, gradient_steps):
    """The state is the curvature: a flat environment pauses, a steep one goes on, a kink undoes most steps."""

    def reward(state, action):
        smooth = -state[:, 0] * (action - 0.3).square().sum(dim=1)
        return torch.where(state[:, 0] < 0, -(action - 0.3).abs().sum(dim=1), smooth)

    model = FunctionModel(lambda state, action: state, reward)
    curvatures = torch.tensor([[0.0], [1.0], [-1.0]])
    planner = PLANNERS["cem_gradient"](
        action_dim=2, horizon=3, num_samples=16, num_iterations=1, gradient_steps=gradient_steps
    )

    def play(states):
        plan, plans = None, []
        for search in range(6):
            plan = planner.plan(model, states, plan, generator=seeded(search))
            plans.append(plan)
        return plans

    together = play(curvatures)
    for row in range(3):
        for alone, batched in zip(play(curvatures[row : row + 1]), together, strict=True):
            torch.testing.assert_close(alone.actions[0], batched.actions[row])
            torch.testing.assert_close(alone.expected_return[0], batched.expected_return[row])
            for name in ("gradient_pause", "gradient_wait"):
                assert alone.info[name][0] == batched.info[name][row]


def test_gradient_step_is_a_twentieth_of_the_range_by_default(make_planner, seeded):
    model = FunctionModel(lambda state, action: state, lambda state, action: action.sum(dim=1))
    planner = make_planner(
        gradient_steps=1, action_low=(-1.0, -20.0), action_high=(1.0, 20.0), init_std=0.0, num_iterations=1, horizon=1
    )
    plan = planner.plan(model, torch.zeros(1, 1), generator=seeded())
    torch.testing.assert_close(plan.action, torch.tensor([[0.1 / 20, 2.0]]))


def test_cem_gradient_is_a_registered_planner_that_halves_the_gap_on_a_smooth_problem(point, states, seeded):
    cem, refined = (
        PLANNERS[name](action_dim=2, horizon=6, num_samples=32, num_iterations=2).plan(
            FunctionModel(point.dynamics, point.reward), states, generator=seeded()
        )
        for name in ("cem", "cem_gradient")
    )
    assert (refined.expected_return >= cem.expected_return - 1e-5).all()
    assert (refined.expected_return > cem.expected_return + 0.005).any()
