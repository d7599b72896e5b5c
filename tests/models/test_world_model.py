"""The planner's view of the world model, with the reference and with the backend for CPUs."""

import copy
import pickle

import pytest
import torch

from latentplan.models import State
from latentplan.models.backend import Backend
from latentplan.models.fast import CpuBackend
from latentplan.planning import CEMPlanner

# One bfloat16 rounding is 0.4 %; a few of them meet along a rollout.
LOOSE = {"rtol": 0.05, "atol": 0.05}


@pytest.fixture
def actions(generator):
    return torch.rand(5, 4, 3, generator=generator) * 2 - 1


@pytest.fixture(params=[Backend, CpuBackend])
def model(request, model):
    """The model with the reference, and with the backend for CPUs."""
    model = copy.deepcopy(model)
    model.backend = request.param()
    return model


def step_through(model, state, actions):
    stepped = []
    for action in actions.unbind(1):
        state, reward = model.step(state, action)
        stepped.append(reward)
    return torch.stack(stepped, 1), state


def test_rollout_equals_repeated_steps(model, state, actions):
    model.backend.trunk_dtype = torch.float32
    rewards, last = model.rollout(state, actions)
    stepped, final = step_through(model, state, actions)
    # Rewards are means over bins of up to 8,100, so their last bits are near a thousandth of their spread.
    assert torch.allclose(rewards, stepped, rtol=1e-3, atol=1e-3 * float(stepped.detach().std()))
    assert all(torch.allclose(left, right, atol=1e-5) for left, right in zip(last, final, strict=True))


def test_rollout_passes_gradients_to_its_actions(model, state, actions):
    rewards, last = model.rollout(state, actions.requires_grad_())
    (gradient,) = torch.autograd.grad(rewards[:, -1].sum() + last.deter.sum(), actions)
    assert gradient.abs().sum(-1).min() > 0.0


def test_rollout_does_not_depend_on_the_block_size(model, state, actions, monkeypatch):
    whole, last = model.rollout(state, actions)
    monkeypatch.setattr("latentplan.models.fast.rollout.ROWS_PER_THREAD", 1)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    in_blocks, also_last = model.rollout(state, actions)
    assert torch.allclose(in_blocks, whole, **LOOSE)
    assert torch.allclose(also_last.deter, last.deter, **LOOSE)


def test_rollout_reward_belongs_to_the_state_after_the_action(model, state, actions):
    _, reward = model.step(state, actions[:, 0])
    _, other = model.step(state, -actions[:, 0])
    assert not torch.allclose(reward, other)
    both, _ = model.rollout(state, actions[:, :2])
    changed, _ = model.rollout(state, torch.stack([actions[:, 0], -actions[:, 1]], 1))
    assert torch.equal(both[:, 0], changed[:, 0])
    assert not torch.allclose(both[:, 1], changed[:, 1])


def test_planner_methods_return_float32(model, state, actions):
    rewards, last = model.rollout(state, actions)
    following, reward = model.step(state, actions[:, 0])
    scalars = [rewards, reward, model.value(state), model.continues(state), model.policy(state)]
    assert all(output.dtype == torch.float32 for output in [*scalars, *last, *following])


def test_planner_methods_compute_each_row_independently(model, state, actions):
    rewards, last = model.rollout(state, actions)
    values, chosen, continues = model.value(state), model.policy(state), model.continues(state)
    for row in range(5):
        own = State(*(part[row : row + 1] for part in state))
        own_rewards, own_last = model.rollout(own, actions[row : row + 1])
        assert torch.allclose(own_rewards[0], rewards[row], **LOOSE)
        assert torch.allclose(own_last.stoch[0], last.stoch[row], **LOOSE)
        assert torch.allclose(model.value(own)[0], values[row], **LOOSE)
        assert torch.allclose(model.policy(own)[0], chosen[row], **LOOSE)
        assert torch.allclose(model.continues(own)[0], continues[row], **LOOSE)


def test_policy_returns_the_mode_without_a_generator_and_samples_with_one(model, state):
    mode = model.policy(state)
    assert torch.equal(mode, model.policy(state))
    first, second = (model.policy(state, torch.Generator().manual_seed(seed)) for seed in (0, 1))
    assert torch.equal(first, model.policy(state, torch.Generator().manual_seed(0)))
    assert not torch.equal(first, second)
    assert max(part.abs().max() for part in (mode, first, second)) <= 1.0


def test_continues_are_probabilities(model, state):
    assert ((model.continues(state) > 0.0) & (model.continues(state) < 1.0)).all()


def test_infer_depends_on_the_frame(model, state, frames, actions):
    believed = model.infer(state, actions[:, 0], frames)
    surprised = model.infer(state, actions[:, 0], 255 - frames)
    assert torch.equal(believed.deter, surprised.deter)
    assert not torch.allclose(believed.stoch, surprised.stoch)
    assert believed.stoch.shape == (5, 32)


def test_infer_equals_advance_then_see(model, state, frames, actions):
    deter = model.dynamics.advance(state, actions[:, 0])
    expected, believed = model.see(deter, frames), model.infer(state, actions[:, 0], frames)
    assert all(torch.equal(left, right) for left, right in zip(expected, believed, strict=True))


def test_planner_plans_with_all_optional_methods(model, state):
    planner = CEMPlanner(
        action_dim=3, horizon=3, num_samples=16, num_elites=4, num_policy_samples=3, use_continues=True
    )
    plan = planner.plan(model, state, generator=torch.Generator().manual_seed(0))
    assert plan.action.shape == (5, 3) and plan.expected_return.isfinite().all()


def test_propose_equals_the_actor_step_by_step(model, state):
    torch.manual_seed(0)
    with torch.no_grad():
        model.actor.mlp.output.weight.normal_(std=0.5)
    generators = [torch.Generator().manual_seed(row) for row in range(5)]
    proposed = model.propose(state, 3, 4, generators).unflatten(0, (5, 3))
    assert proposed.abs().max() <= 1.0
    believed, expected = state, []
    for _ in range(4):
        expected.append(model.policy(believed))
        believed, _ = model.step(believed, expected[-1])
    assert torch.allclose(proposed[:, 0], torch.stack(expected, 1), atol=0.03)  # both round to bfloat16, elsewhere
    assert not torch.allclose(proposed[:, 1], proposed[:, 2], atol=0.05)
    alone = model.propose(State(*(part[2:3] for part in state)), 3, 4, [torch.Generator().manual_seed(2)])
    assert torch.allclose(alone, proposed[2], atol=0.03)


def test_rollout_uses_weights_that_changed_in_place_or_were_replaced(model, state, actions):
    def planned():
        with torch.no_grad(), model.trunk_precision():
            return model.rollout(state, actions)[0]

    first = planned()
    assert torch.equal(planned(), first)
    with torch.no_grad():
        model.dynamics.gates.weight.mul_(0.5)
    second = planned()
    assert not torch.equal(second, first)
    model.load_state_dict({name: 2.0 * value for name, value in model.state_dict().items()})
    third = planned()
    assert not torch.equal(third, second)
    output = model.reward_head.mlp.output
    output.bias = torch.nn.Parameter(torch.linspace(-1.0, 1.0, len(output.bias)))
    assert not torch.equal(planned(), third)


def test_model_can_be_copied_and_pickled_after_a_rollout(model, state, actions):
    with torch.no_grad(), model.trunk_precision():
        expected = model.rollout(state, actions)[0]
    for twin in (copy.deepcopy(model), pickle.loads(pickle.dumps(model))):
        with torch.no_grad(), twin.trunk_precision():
            assert torch.equal(twin.rollout(state, actions)[0], expected)


def test_rollout_uses_changed_weights_of_inference_mode(model, state, actions):
    with torch.inference_mode():
        twin = copy.deepcopy(model)
        with twin.trunk_precision():
            before = twin.rollout(state, actions)[0]
        twin.dynamics.gates.weight.mul_(0.5)
        with twin.trunk_precision():
            assert not torch.equal(twin.rollout(state, actions)[0], before)
