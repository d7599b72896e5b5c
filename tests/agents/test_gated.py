"""The gated agent: plans doubtful decisions within its budget, warm-started from the aged plan."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from latentplan.agents.actor import ActorAgent
from latentplan.agents.gated import SIGNALS, GatedAgent, RunningScale
from latentplan.agents.planning import PlanningAgent
from latentplan.config import Config, PlannerConfig
from latentplan.planning import rate_limit
from tests.agents.small_agents import SIZES, make_plain_model

CONFIG = Config(
    model=SIZES,
    planner=PlannerConfig(
        horizon=3, num_samples=8, num_elites=3, num_iterations=3, warm_start_iterations=1, num_policy_samples=0
    ),
)


@pytest.fixture(scope="module")
def model():
    return make_plain_model(heads=("reward_head", "value_head", "actor"))


@pytest.fixture
def film():
    """Forty frames of three environments, (time, environment, 64, 64, 3)."""
    return np.random.default_rng(0).integers(0, 256, (40, 3, 64, 64, 3), dtype=np.uint8)


def make(model, **options):
    return GatedAgent(model, CONFIG, 0.9, **options)


class Script(GatedAgent):
    """A gated agent with a given doubt at each decision."""

    def __init__(self, model, doubts):
        super().__init__(model, CONFIG, 0.9)
        self.doubts = iter(doubts)

    def _is_doubtful(self, state, action, is_due):
        return torch.tensor(next(self.doubts)).expand(len(action))


@pytest.mark.parametrize("signal", SIGNALS)
def test_planned_fraction_approaches_the_budget(model, film, signal):
    agent = make(model, planning_budget=0.2, signal=signal)
    for index in range(200):  # 600 decisions, three in each batch
        agent.act(film[index % 37])
    # The excess is the change of the threshold divided by 0.1 * 600: 0.05 is a change of three standard deviations.
    assert agent.planned_fraction == pytest.approx(0.2, abs=0.05)
    assert agent.planned_fraction <= 0.2


@pytest.mark.parametrize("goal", [None, lambda rollout: rollout.actions[:, 0, 0]])
@pytest.mark.parametrize("signal", SIGNALS)
def test_gated_agent_exceeds_the_budget_only_by_decisions_that_must_be_planned(model, film, signal, goal):
    agent = make(model, planning_budget=0.4, signal=signal)
    agent.set_objective(goal)
    for index in range(60):
        agent.act(film[index % 37, 0])
        num_ended_plans = 0 if goal is None else index // 3
        assert agent._num_planned <= max(1 + num_ended_plans, 0.4 * (index + 1)) + 1e-6
    assert agent.planned_fraction > 0.15


def test_gated_agent_plans_the_most_doubtful_environments_when_the_budget_does_not_cover_all(model, film):
    agent = make(model, planning_budget=0.4, signal="value")
    agent._value_gap = lambda state, action: 1.0 + 0.1 * torch.rand(3)
    for frames in film[:5]:
        agent.act(frames)
    agent._num_planned, agent.threshold = 6, 0.0  # the budget of 18 decisions, 7.2, leaves one more plan
    agent._value_gap = lambda state, action: torch.tensor([30.0, 10.0, 20.0])
    agent.act(film[5])
    assert agent.last_source == ["plan", "actor", "actor"]


def test_signal_is_the_mismatch_since_the_last_plan_under_an_untrained_goal(model, film):
    agent = make(model, planning_budget=0.3, signal="value")
    agent.set_objective(lambda rollout: rollout.actions[:, 0, 0])
    expected, seen = 0.0, []
    for frames in film[:12]:
        agent.act(frames[0])
        seen.append(agent.last_source)
        expected = 0.0 if seen[-1] == "plan" else expected + agent._mismatch.item()
        assert agent._drift.item() == pytest.approx(expected, rel=1e-5)
    assert "tail" in seen and agent._scales["drift"].num > 0 and agent._scales["value"].num == 0


def test_planned_fraction_counts_first_decisions_of_episodes(model, film):
    agent = make(model, planning_budget=0.3, signal="mismatch")
    for index in range(200):
        if index % 10 == 0:
            agent.reset()
        agent.act(film[index % 37])
    assert agent.planned_fraction == pytest.approx(0.3, abs=0.05)


def test_planned_fraction_equals_the_budget_when_that_is_0_or_1(model, film):
    always, never = make(model, planning_budget=1.0), make(model, planning_budget=0.0)
    assert always.planned_fraction == never.planned_fraction == 0.0
    for frames in film[:20]:
        always.act(frames[0])
        never.act(frames[0])
    assert always.planned_fraction == 1.0
    assert never.planned_fraction == 1 / 20  # the first decision of the episode


def test_gated_agent_acts_as_the_planner_at_budget_1_and_as_the_actor_without_doubt(model, film):
    always, planner = make(model, planning_budget=1.0, seed=3), PlanningAgent(model, CONFIG, 0.9, seed=3)
    for frames in film[:6]:
        assert np.array_equal(always.act(frames[0]), planner.act(frames[0]))
    never, actor = Script(model, [False] * 6), ActorAgent(model, CONFIG)
    never.act(film[0, 0])
    actor.act(film[0, 0])
    actor.state, actor._action = never.state, never._action  # the first decision is always planned
    for frames in film[1:6]:
        assert np.allclose(never.act(frames[0]), actor.act(frames[0]), atol=1e-6)


def test_gated_agent_plans_the_first_decision_of_an_episode(model, film):
    agent = make(model, planning_budget=0.0)
    sources = []
    for index in range(6):
        if index == 3:
            agent.reset()
        agent.act(film[index, 0])
        sources.append(agent.last_source)
    assert sources == ["plan", "actor", "actor"] * 2


def test_gated_agent_plans_only_masked_environments_after_a_masked_reset(model, film):
    agent = make(model, planning_budget=0.0)
    agent.act(film[0])
    assert agent.last_source == ["plan"] * 3
    agent.act(film[1])
    agent.reset(np.array([False, True, False]))
    agent.act(film[2])
    assert agent.last_source == ["actor", "plan", "actor"]
    assert agent.planned_fraction == pytest.approx(4 / 9)


def test_next_search_starts_from_the_shifted_plan_when_the_actor_acted_in_between(model, film):
    agent = Script(model, [True, True, False, True])
    agent.act(film[0, 0])
    agent.act(film[1, 0])
    assert agent.imagine() is not None
    last = agent.controller.plan
    agent.act(film[2, 0])
    assert agent.last_source == "actor" and agent.imagine() is None
    assert agent.controller.plan.elapsed.tolist() == [2]
    shifted = []
    search = agent.controller.planner.__class__.plan

    def plan(self, model, state, previous=None, **options):
        shifted.append(previous)
        return search(self, model, state, previous, **options)

    agent.controller.planner.__class__.plan = plan
    try:
        agent.act(film[3, 0])
    finally:
        agent.controller.planner.__class__.plan = search
    assert shifted[0].elapsed.tolist() == [2] and torch.equal(shifted[0].actions, last.actions)
    assert agent.controller.plan.info["iterations"].tolist() == [1]


def test_next_search_starts_cold_when_the_plan_has_run_out(model, film):
    agent = Script(model, [True, False, False, False, True])
    for frames in film[:5]:
        agent.act(frames[0])
    assert agent.last_source == "plan"
    assert agent.controller.plan.info["iterations"].tolist() == [3]


def test_gated_agent_plans_where_the_signal_is_an_outlier(model, film):
    agent = make(model, planning_budget=0.05, signal="value")
    gaps = iter([1.0, 2.0, 3.0] * 20 + [50.0, 2.0])
    agent._value_gap = lambda state, action: torch.full((len(action),), next(gaps))
    for index in range(60):
        agent.act(film[index % 20, 0])
    for frames, source in zip(film[21:23], ("plan", "actor"), strict=True):
        agent.act(frames[0])
        assert agent.last_source == source


def test_mismatch_is_the_divergence_of_posterior_and_prior(model, film):
    agent = make(model, signal="mismatch")
    action = agent.act(film[0])
    deter = model.dynamics.advance(agent.state, torch.as_tensor(action))
    agent.act(film[1])
    posterior = model.dynamics.posterior(deter, model.encoder(torch.as_tensor(film[1])))
    expected = torch.distributions.kl_divergence(
        *(torch.distributions.Normal(*gaussian) for gaussian in (posterior, model.dynamics.prior(deter)))
    ).sum(1)
    torch.testing.assert_close(agent._mismatch, expected, atol=1e-3, rtol=1e-3)


def test_value_gap_is_the_difference_to_the_return_of_two_actor_steps(model, film):
    agent = make(model, signal="value")
    agent.act(film[0])
    state = agent.state
    first, reward = model.step(state, model.policy(state))
    second, later = model.step(first, model.policy(first))
    expected = (reward + 0.9 * later + 0.81 * model.value(second) - model.value(state)).abs()
    gap = agent._value_gap(state, model.policy(state))
    torch.testing.assert_close(gap, expected, atol=0.05, rtol=0.05)  # bfloat16


def test_gated_agent_plans_and_keeps_its_statistics_when_the_signal_is_nan(model, film):
    agent = make(model, planning_budget=0.2, signal="value")
    agent._value_gap = lambda state, action: torch.full((len(action),), float("nan"))
    for frames in film[:5]:
        agent.act(frames[0])
    assert agent.planned_fraction == 1.0 and agent._scales["value"].num == 0


def test_gated_agent_acts_by_the_actor_when_no_candidate_has_a_finite_return(model, film):
    broken = copy.deepcopy(model)
    with torch.no_grad():
        broken.reward_head.mlp.output.weight.fill_(torch.nan)
    gated, actor = make(broken, planning_budget=1.0), ActorAgent(broken, CONFIG)
    with pytest.warns(RuntimeWarning, match="nothing finite"):
        for frames in film[:3]:
            np.testing.assert_allclose(gated.act(frames), actor.act(frames), atol=0.02)  # bfloat16
            assert gated.last_source == ["actor"] * 3


def test_gated_agent_reports_the_actor_when_the_deadline_leaves_no_time_for_a_search(model, film):
    agent = make(model, planning_budget=1.0, planner=replace(CONFIG.planner, deadline_ms=1e-6))
    for frames in film[:3]:
        agent.act(frames)
        assert agent.last_source == ["actor"] * 3
    assert agent.planned_fraction == 1.0  # share of decisions with a requested search


def test_signals_choose_different_decisions(model, film):
    moments = {}
    for signal in SIGNALS:
        agent, sources = make(model, planning_budget=0.3, signal=signal), []
        for frame in film.swapaxes(0, 1).reshape(-1, 64, 64, 3):  # 120 decisions: in a few, two signals may agree
            agent.act(frame)
            sources.append(agent.last_source)
        moments[signal] = tuple(sources)
    assert len(set(moments.values())) == len(SIGNALS)


@pytest.mark.parametrize("signal", SIGNALS)
def test_act_repeats_with_the_seed(model, film, signal):
    left, right = (make(model, signal=signal, seed=4) for _ in range(2))
    for frames in film[:10]:
        actions = left.act(frames)
        assert np.array_equal(actions, right.act(frames))
        assert actions.shape == (3, 2) and actions.dtype == np.float32 and np.abs(actions).max() <= 1.0
    assert left.encode(film[0, 0]).shape == (32,)


def test_running_scale_has_the_mean_and_std_of_all_values():
    values = torch.randn(50, generator=torch.Generator().manual_seed(0))
    scale = RunningScale()
    first = scale.standardise(values[:1], torch.ones(1, dtype=torch.bool))
    for value in values[1:]:
        last = scale.standardise(value[None], torch.ones(1, dtype=torch.bool))
    assert first.item() == 0.0
    assert scale.mean == pytest.approx(values.mean().item(), abs=1e-6)
    assert scale.std == pytest.approx(values.std(correction=0).item(), abs=1e-6)
    assert last.item() == pytest.approx(((values[-1] - values[:-1].mean()) / values[:-1].std(correction=0)).item())


@pytest.mark.parametrize(("options", "words"), [({"planning_budget": 1.2}, "1.2"), ({"signal": "noise"}, "mismatch")])
def test_gated_agent_refuses_a_budget_above_1_and_an_unknown_signal(model, options, words):
    with pytest.raises(ValueError, match=words):
        make(model, **options)


def test_gated_agent_executes_the_rest_of_the_plan_under_an_untrained_goal(model, film):
    agent, sources = make(model, planning_budget=0.3, signal="random"), []
    agent.set_objective(lambda rollout: -rollout.actions[:, 0, 0])
    for frames in film:
        expected = agent.controller.next_actions()
        action = agent.act(frames[0])
        sources.append(agent.last_source)
        if agent.last_source == "tail":
            assert expected is not None and np.allclose(action, expected[0][0].numpy())
    horizon = agent.controller.planner.horizon
    assert set(sources) == {"plan", "tail"} and sources[0] == "plan"
    longest = max(len(run) for run in "".join(source[0] for source in sources).split("p"))
    assert 1 <= longest <= horizon - 1  # a search follows the end of a plan


def test_gated_agent_plans_at_once_when_an_objective_is_set(model, film):
    agent = make(model, planning_budget=0.0)
    for goal in (lambda rollout: rollout.actions[:, 0, 0], lambda rollout: -rollout.actions[:, 0, 0]):
        agent.set_objective(goal)
        agent.act(film[1, 0])
        assert agent.last_source == "plan"
    for learned in (None, "return"):
        agent.set_objective(learned)
        agent.act(film[2, 0])
        assert agent.last_source == "actor"


def test_rate_limit_holds_between_plans_their_tails_and_the_actor(model, film):
    """Between searches the agent executes the rest of its plan; the next plan starts from the action executed last."""
    agent = make(model, planning_budget=0.3)
    agent.set_objective(lambda rollout: rollout.actions[:, 0, 0], [rate_limit(0.1)])
    actions = np.stack([agent.act(frames) for frames in film[:20]])
    assert np.abs(np.diff(actions, axis=0)).max() <= 0.1 + 1e-5
    assert agent.planned_fraction < 1.0
