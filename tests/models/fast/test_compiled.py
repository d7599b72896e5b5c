import pytest
import torch
from torch import nn

from latentplan.config import ModelConfig
from latentplan.models.dynamics import State
from latentplan.models.fast import CpuBackend
from latentplan.models.fast import compiled as fused
from latentplan.models.fast.rollout import imagine, lay_out, propose
from latentplan.models.world_model import WorldModel

ROWS, TIME, ACTION = 70, 4, 3  # three blocks, the last one of six rows
SIZES = ModelConfig(deter_dim=64, hidden_dim=96, latent_dim=32, num_bins=31)


def build(config=SIZES):
    torch.manual_seed(0)
    model = WorldModel(config, ACTION)
    for parameter in model.parameters():
        nn.init.normal_(parameter, std=parameter.shape[-1] ** -0.5)
    model.backend = CpuBackend()
    return model


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def start(rows=ROWS):
    return State(draw(rows, 64).tanh(), draw(rows, 32, seed=1))


def weights_of(model):
    with torch.no_grad(), model.trunk_precision():
        return model.backend._weights(model)


WEIGHTS = weights_of(build())
compiled = pytest.mark.skipif(WEIGHTS.packed is None, reason="no compiler, or a processor without bfloat16 products")


def asked(name):
    """One call of each compiled rollout on some of the rows."""
    state, actions = start(), draw(ROWS, TIME, ACTION, seed=2)

    def imagined(weights, rows=slice(None)):
        rewards, last = imagine(weights, State(*(part[rows] for part in state)), actions[rows].clamp(-1.0, 1.0))
        return rewards, *last

    def proposed(weights, rows=slice(None)):
        return (propose(weights, State(*(part[rows] for part in state)), actions[rows]),)

    return {"imagine": imagined, "propose": proposed}[name]


@compiled
@pytest.mark.parametrize("name", ["imagine", "propose"])
def test_the_compiled_rollout_is_as_near_to_float32_as_torch_in_bfloat16(name):
    model, ask = build(), asked(name)
    with torch.no_grad(), torch.autocast("cpu", enabled=False):
        exact = ask(lay_out(model.dynamics, model.reward_head, model.value_head, model.actor, torch.float32))
    for truth, compiled_part, torch_part in zip(exact, ask(WEIGHTS), ask(WEIGHTS._replace(packed=None)), strict=True):
        assert compiled_part.shape == truth.shape and compiled_part.dtype == torch.float32
        error, torch_error = ((part - truth).square().mean().sqrt() for part in (compiled_part, torch_part))
        assert 0.0 < error < 1.2 * torch_error


@compiled
@pytest.mark.parametrize("name", ["imagine", "propose"])
def test_a_row_does_not_depend_on_who_shares_the_call(name):
    ask = asked(name)
    for whole, part, alone in zip(ask(WEIGHTS), ask(WEIGHTS, slice(30, 68)), ask(WEIGHTS, slice(40, 41)), strict=True):
        assert torch.equal(whole[30:68], part)
        assert torch.equal(whole[40:41], alone)


@compiled
def test_values_are_those_of_the_value_head_and_rows_are_judged_alone():
    model, state = build(), start()
    with torch.no_grad(), torch.autocast("cpu", enabled=False):
        exact = model.value_head.mean(model.value_head(state.features))
    with torch.no_grad():
        rounded = model.value(state)
        with model.trunk_precision():
            values, alone = model.value(state), model.value(State(*(part[40:41] for part in state)))
    errors = [(found - exact).square().mean().sqrt() for found in (values, rounded)]
    assert 0.0 < errors[0] < 1.2 * errors[1]
    assert torch.equal(values[40:41], alone)


@compiled
def test_a_step_of_a_search_is_a_rollout_of_one():
    model, state, action = build(), start(), draw(ROWS, ACTION).clamp(-1.0, 1.0)
    with torch.no_grad(), model.trunk_precision():
        following, reward = model.fast_step(state, action)
        rewards, last = model.rollout(state, action.unsqueeze(1))
    assert torch.equal(reward, rewards[:, 0]) and all(map(torch.equal, following, last))


@compiled
def test_the_number_of_threads_changes_nothing():
    ask, before = asked("imagine"), torch.get_num_threads()
    results = []
    for threads in (1, 3):
        torch.set_num_threads(threads)
        results.append(ask(WEIGHTS))
    torch.set_num_threads(before)
    assert all(torch.equal(left, right) for left, right in zip(*results, strict=True))


@compiled
def test_nan_stays_nan_and_stays_in_its_row():
    actions = draw(ROWS, TIME, ACTION).clamp(-1.0, 1.0)
    actions[40, 1, 0] = float("nan")
    rewards, last = imagine(WEIGHTS, start(), actions)
    others = [row for row in range(ROWS) if row != 40]
    assert rewards[40, 0].isfinite() and rewards[40, 1:].isnan().all() and last.deter[40].isnan().all()
    assert rewards[others].isfinite().all() and last.stoch[others].isfinite().all()
    assert propose(WEIGHTS, start(), actions)[40, 1:, 0].isnan().all()


@compiled
def test_what_is_given_is_left_as_it_was():
    state, actions = start(), draw(ROWS, TIME, ACTION)
    copies = [tensor.clone() for tensor in (*state, actions)]
    imagine(WEIGHTS, state, actions)
    propose(WEIGHTS, state, actions)
    assert all(torch.equal(left, right) for left, right in zip((*state, actions), copies, strict=True))


@compiled
def test_actions_may_be_views_and_need_not_be_float32():
    actions = draw(TIME, ROWS, ACTION).clamp(-1.0, 1.0)
    expected, _ = imagine(WEIGHTS, start(), actions.transpose(0, 1).contiguous())
    assert torch.equal(imagine(WEIGHTS, start(), actions.transpose(0, 1))[0], expected)
    rounded = actions.transpose(0, 1).bfloat16()
    assert torch.equal(imagine(WEIGHTS, start(), rounded)[0], expected)  # they are rounded in any case


@compiled
def test_gradients_pass_where_they_are_asked_for():
    model, actions = build(), draw(ROWS, TIME, ACTION).clamp(-1.0, 1.0).requires_grad_()
    with model.trunk_precision():
        rewards, last = model.rollout(start(), actions)
        (by_reward,) = torch.autograd.grad(rewards.sum(), actions, retain_graph=True)
        (by_value,) = torch.autograd.grad(model.value(last).sum(), actions)
    assert by_reward.abs().sum() > 0.0 and by_value.abs().sum() > 0.0


def test_other_sizes_and_other_precisions_are_left_to_torch():
    odd = ModelConfig(deter_dim=64, hidden_dim=40, latent_dim=32, num_bins=31)
    assert weights_of(build(odd)).packed is None
    assert (
        fused.pack(WEIGHTS._replace(gates=WEIGHTS.gates.float()), (WEIGHTS.head, WEIGHTS.logits, WEIGHTS.logits_shift))
        is None
    )


@compiled
def test_a_latent_may_be_the_widest_layer():
    sizes = ModelConfig(deter_dim=32, hidden_dim=32, latent_dim=512, num_bins=31)
    weights = weights_of(build(sizes))
    state, actions = State(draw(ROWS, 32).tanh(), draw(ROWS, 512, seed=1)), draw(ROWS, TIME, ACTION, seed=2)
    assert weights.packed is not None
    rewards, last = imagine(weights, state, actions)
    expected, reached = imagine(weights._replace(packed=None), state, actions)
    torch.testing.assert_close(rewards, expected, atol=0.1, rtol=0.1)
    torch.testing.assert_close(last.stoch, reached.stoch, atol=0.1, rtol=0.1)


@compiled
@pytest.mark.parametrize("wrong", ["actions", "rows", "deter"])
def test_what_does_not_fit_the_model_is_refused(wrong):
    state, actions = start(), draw(ROWS, TIME, ACTION + (wrong == "actions"))
    state = State(state.deter[:, : 32 if wrong == "deter" else 64], state.stoch[: 5 if wrong == "rows" else ROWS])
    with pytest.raises(ValueError, match="deter, stoch and actions have shapes"):
        imagine(WEIGHTS, state, actions)
