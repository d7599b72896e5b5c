"""Properties of all agents: shapes and bounds of actions, random streams, resets, exploration."""

import numpy as np
import pytest
import torch

from latentplan.agents.actor import ActorAgent
from latentplan.agents.planning import PlanningAgent
from latentplan.agents.random import RandomAgent
from tests.agents.small_agents import CONFIG, make_model


@pytest.fixture(scope="module")
def model():
    return make_model()


def make_planner(model, **options):
    return PlanningAgent(model, CONFIG, 0.9, **options)


def make_actor(model, **options):
    return ActorAgent(model, CONFIG, **options)


AGENTS = [pytest.param(make_planner, id="planner"), pytest.param(make_actor, id="actor")]


@pytest.mark.parametrize("make", AGENTS)
def test_act_returns_bounded_float32_actions(make, model, film):
    agent = make(model)
    assert agent.num_actions == 2 and agent.config is CONFIG
    action = agent.act(film[0, 0])
    assert action.shape == (2,) and action.dtype == np.float32 and np.abs(action).max() <= 1.0
    agent.reset()
    actions = agent.act(film[0])
    assert actions.shape == (3, 2) and actions.dtype == np.float32 and np.abs(actions).max() <= 1.0


@pytest.mark.parametrize("make", AGENTS)
def test_act_gives_a_single_frame_the_action_of_a_batch_of_one(make, model, film):
    alone, batched = make(model, seed=3), make(model, seed=3)
    for frames in film:
        assert np.array_equal(alone.act(frames[0]), batched.act(frames[:1])[0])


@pytest.mark.parametrize("make", AGENTS)
def test_act_gives_each_environment_of_a_batch_its_own_action(make, model, film):
    for frames in film:
        together, alone = make(model, seed=3), make(model, seed=3)
        # A batch is summed in another order than a single row, which in bfloat16 can exchange two elites.
        assert np.allclose(together.act(frames)[1], alone.act(frames[1]), atol=0.1)


@pytest.mark.parametrize("make", AGENTS)
def test_act_repeats_with_the_seed(make, model, film):
    agent = make(model)
    histories = []
    for seed in (5, 5):
        agent.reset()
        agent.seed(seed)
        histories.append(np.stack([agent.act(frames) for frames in film]))
    assert np.array_equal(*histories)


@pytest.mark.parametrize("make", AGENTS)
def test_reset_forgets_the_past(make, model, film):
    agent, fresh = make(model), make(model)
    for frames in film:
        agent.act(frames)
    agent.reset()
    agent.seed(7)
    fresh.seed(7)
    assert np.array_equal(agent.act(film[2]), fresh.act(film[2]))


@pytest.mark.parametrize("make", AGENTS)
def test_masked_reset_forgets_the_past_of_masked_environments_only(make, model, film):
    agent, kept, fresh = make(model), make(model), make(model)
    for frames in film[:3]:
        agent.act(frames)
        kept.act(frames)
    agent.reset(np.array([False, True, False]))
    for one in (agent, kept, fresh):
        one.seed(7)
        one.act(film[3])
    for ours, kepts, freshs in zip(agent.state, kept.state, fresh.state, strict=True):
        assert torch.allclose(ours[[0, 2]], kepts[[0, 2]], atol=1e-5)
        assert torch.allclose(ours[1], freshs[1], atol=1e-5)
        assert not torch.allclose(ours[1], kepts[1], atol=1e-3)


@pytest.mark.parametrize("make", AGENTS)
def test_reset_refuses_a_mask_of_another_length_and_changes_nothing(make, model, film):
    agent = make(model)
    agent.act(film[0])
    with pytest.raises(ValueError, match="a mask of 2 for 3"):
        agent.reset(np.array([True, False]))
    agent.act(film[0])


@pytest.mark.parametrize("make", AGENTS)
def test_masked_resets_add_up_until_the_next_decision(make, model, film):
    agent, fresh = make(model), make(model)
    agent.act(film[0])
    agent.reset(np.array([True, False, False]))
    agent.reset(np.array([False, True, False]))
    agent.act(film[1])
    fresh.act(film[1])
    assert torch.allclose(agent.state.stoch[:2], fresh.state.stoch[:2], atol=1e-5)


def test_belief_is_updated_with_the_executed_action(model, film):
    noisy = make_planner(model, noise_std=0.5)
    action = noisy.act(film[0])
    before = noisy.state
    noisy.act(film[1])
    expected = model.infer(before, torch.as_tensor(action), torch.as_tensor(film[1]))
    assert all(torch.allclose(left, right, atol=1e-5) for left, right in zip(noisy.state, expected, strict=True))


@pytest.mark.parametrize("make", AGENTS)
def test_changes_of_the_returned_action_do_not_reach_the_agent(make, model, film):
    agent, same = make(model), make(model)
    for frames in film[:3]:
        action = agent.act(frames)
        assert np.array_equal(action, same.act(frames))
        action *= 10.0


@pytest.mark.parametrize("make", AGENTS)
def test_agent_with_the_memory_of_another_has_its_surprise_and_actor(make, model, film):
    agent, other = make(model), make(model)
    agent.act(film[0])
    other.set_memory(agent.memory())
    assert other.surprise() == agent.surprise()
    assert np.array_equal(other.actor_action(), agent.actor_action())


def test_exploration_noise_changes_actions_within_the_bounds(model, film):
    plain, noisy = make_planner(model).act(film[0]), make_planner(model, noise_std=5.0).act(film[0])
    assert not np.allclose(plain, noisy)
    assert np.abs(noisy).max() <= 1.0


def test_actor_samples_only_when_it_explores(model, film):
    firm, free = make_actor(model), make_actor(model, explore=True)
    actions = {True: [], False: []}
    for seed in (0, 1):
        for explores, agent in ((False, firm), (True, free)):
            agent.reset()
            agent.seed(seed)
            actions[explores].append(agent.act(film[0]))
    assert np.array_equal(*actions[False])
    assert not np.array_equal(*actions[True])
    assert np.abs(actions[True]).max() <= 1.0


@pytest.mark.parametrize("make", AGENTS)
@pytest.mark.parametrize(
    "frame",
    [
        np.zeros((64, 64, 3), np.float32),
        np.zeros((32, 64, 3), np.uint8),
        np.zeros((3, 64, 64), np.uint8),
        np.zeros((64, 64), np.uint8),
        np.zeros((1, 2, 64, 64, 3), np.uint8),
    ],
)
def test_act_and_encode_refuse_arrays_that_are_no_frames(make, model, frame):
    agent = make(model)
    with pytest.raises(ValueError, match=r"frames must be uint8 \(64, 64, 3\), got"):
        agent.act(frame)
    with pytest.raises(ValueError, match=r"frames must be uint8 \(64, 64, 3\), got"):
        agent.encode(frame)


def test_act_and_encode_say_that_frames_are_numpy_arrays(model):
    agent, frame = ActorAgent(model, CONFIG), torch.zeros(64, 64, 3, dtype=torch.uint8)
    for method in (agent.act, agent.encode):
        with pytest.raises(ValueError, match="frames must be a NumPy array, got Tensor"):
            method(frame)


@pytest.mark.parametrize("make", AGENTS)
def test_act_refuses_another_batch_size_without_a_reset(make, model, film):
    agent = make(model)
    agent.act(film[0])
    with pytest.raises(ValueError, match=r"call reset\(\)"):
        agent.act(film[0, :2])
    agent.reset()
    assert agent.act(film[0, :2]).shape == (2, 2)


@pytest.mark.parametrize("make", AGENTS)
def test_encode_gives_the_latent_and_changes_no_state(make, model, film):
    agent, other = make(model, seed=1), make(model, seed=1)
    latent = agent.encode(film[0, 0])
    assert latent.shape == (32,) and latent.dtype == np.float32
    assert np.allclose(agent.encode(film[0])[0], latent, atol=1e-5)
    assert not np.allclose(agent.encode(film[1, 0]), latent)
    assert np.array_equal(agent.act(film[0]), other.act(film[0]))


def test_act_changes_no_weight(model, film):
    before = {name: value.clone() for name, value in model.state_dict().items()}
    make_planner(model).act(film[0])
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    assert all(parameter.grad is None for parameter in model.parameters())


def test_random_agent_fills_the_bounds_and_repeats_with_its_seed(film):
    agent = RandomAgent(2, seed=4)
    actions = np.stack([agent.act(film[0]) for _ in range(100)])
    assert actions.shape == (100, 3, 2) and actions.dtype == np.float32
    assert -1.0 <= actions.min() < -0.9 and 0.9 < actions.max() <= 1.0
    agent.seed(4)
    assert np.array_equal(agent.act(film[0]), actions[0])
    assert agent.act(film[0, 0]).shape == (2,) and agent.imagine() is None


def _noises(agent, frames, decisions):
    """The agent's exploration noise of each decision, (decision, batch, action)."""
    return torch.stack([agent.noise.draw(torch.zeros(frames, 2), agent.generator) for _ in range(decisions)])


@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_noise_has_variance_1_and_the_given_correlation(correlation, model):
    noise = _noises(make_actor(model, explore=True, noise_correlation=correlation), 2000, 20)
    assert noise.var() == pytest.approx(1.0, abs=0.03)
    lags = [(noise[lag:] * noise[: 20 - lag]).mean().item() for lag in (1, 2)]
    assert lags == pytest.approx([correlation, correlation**2], abs=0.03)


def test_noise_is_independent_of_the_past_when_an_episode_begins(model, film):
    kept, reset = (make_actor(model, explore=True, noise_correlation=0.99, seed=3) for _ in range(2))
    for agent in (kept, reset):
        agent.act(film[0])
    first = reset.noise.last
    reset.reset(np.array([True] + [False] * (len(film[0]) - 1)))
    for agent in (kept, reset):
        agent.act(film[1])
    assert torch.equal(kept.noise.last[1:], reset.noise.last[1:])
    assert not torch.allclose(first[0], reset.noise.last[0], atol=0.3)


@pytest.mark.parametrize("make", AGENTS)
def test_act_takes_flipped_views_of_frames(make, model, film):
    flipped = film[0, 0][::-1]
    assert np.array_equal(make(model, seed=3).act(flipped), make(model, seed=3).act(flipped.copy()))


@pytest.mark.parametrize("make", AGENTS)
@pytest.mark.filterwarnings("error")
def test_act_takes_frames_in_memory_that_may_not_be_written(make, model, film):
    """Cameras give such memory, for which torch would warn of undefined behaviour."""
    frame = np.frombuffer(film[0, 0].tobytes(), np.uint8).reshape(64, 64, 3)
    assert np.array_equal(make(model).act(frame), make(model).act(film[0, 0]))
