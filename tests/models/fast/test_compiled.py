"""Compiled calls: rows, threads, inputs and sizes; their results are compared in `test_backends`."""

import pytest
import torch
from torch import nn

from latentplan.config import ModelConfig
from latentplan.models.dynamics import State
from latentplan.models.fast import CpuBackend, compiled
from latentplan.models.fast.rollout import imagine, propose
from latentplan.models.world_model import WorldModel

ROWS, TIME, ACTION = 70, 4, 3  # three blocks, the last one of six rows
SIZES = ModelConfig(deter_dim=64, hidden_dim=96, decoder_width=48, latent_dim=32, num_bins=31)


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


@pytest.fixture(scope="module")
def weights():
    """Weights for compiled calls."""
    found = weights_of(build())
    if found.packed is None:
        pytest.skip("no compiler, or a processor that multiplies in another precision")
    return found


def make_call(name):
    """A function that makes a compiled call with the same input every time, for some rows."""
    state, actions = start(), draw(ROWS, TIME, ACTION, seed=2)

    def imagined(weights, rows=slice(None)):
        rewards, last = imagine(weights, State(*(part[rows] for part in state)), actions[rows].clamp(-1.0, 1.0))
        return rewards, *last

    def proposed(weights, rows=slice(None)):
        return (propose(weights, State(*(part[rows] for part in state)), actions[rows]),)

    return {"imagine": imagined, "propose": proposed}[name]


@pytest.mark.parametrize("name", ["imagine", "propose"])
def test_compiled_call_computes_each_row_independently(weights, name):
    call = make_call(name)
    for whole, part, alone in zip(
        call(weights), call(weights, slice(30, 68)), call(weights, slice(40, 41)), strict=True
    ):
        assert torch.equal(whole[30:68], part)
        assert torch.equal(whole[40:41], alone)


def test_compiled_value_computes_each_row_independently(weights):
    model, state = build(), start()
    with torch.no_grad():
        assert torch.equal(model.value(state)[40:41], model.value(State(*(part[40:41] for part in state))))


def test_fast_step_equals_a_rollout_of_one_step(weights):
    model, state, action = build(), start(), draw(ROWS, ACTION).clamp(-1.0, 1.0)
    with torch.no_grad(), model.trunk_precision():
        following, reward = model.fast_step(state, action)
        rewards, last = model.rollout(state, action.unsqueeze(1))
    assert torch.equal(reward, rewards[:, 0]) and all(map(torch.equal, following, last))


def test_compiled_rollout_does_not_depend_on_the_number_of_threads(weights):
    call, before = make_call("imagine"), torch.get_num_threads()
    results = []
    for threads in (1, 3):
        torch.set_num_threads(threads)
        results.append(call(weights))
    torch.set_num_threads(before)
    assert all(torch.equal(left, right) for left, right in zip(*results, strict=True))


def test_compiled_call_keeps_nan_in_its_row(weights):
    actions = draw(ROWS, TIME, ACTION).clamp(-1.0, 1.0)
    actions[40, 1, 0] = float("nan")
    rewards, last = imagine(weights, start(), actions)
    others = [row for row in range(ROWS) if row != 40]
    assert rewards[40, 0].isfinite() and rewards[40, 1:].isnan().all() and last.deter[40].isnan().all()
    assert rewards[others].isfinite().all() and last.stoch[others].isfinite().all()
    assert propose(weights, start(), actions)[40, 1:, 0].isnan().all()


def test_compiled_call_leaves_its_inputs_unchanged(weights):
    state, actions = start(), draw(ROWS, TIME, ACTION)
    copies = [tensor.clone() for tensor in (*state, actions)]
    imagine(weights, state, actions)
    propose(weights, state, actions)
    assert all(torch.equal(left, right) for left, right in zip((*state, actions), copies, strict=True))


def test_compiled_rollout_accepts_views_and_bfloat16_actions(weights):
    actions = draw(TIME, ROWS, ACTION).clamp(-1.0, 1.0)
    expected, _ = imagine(weights, start(), actions.transpose(0, 1).contiguous())
    assert torch.equal(imagine(weights, start(), actions.transpose(0, 1))[0], expected)
    rounded = actions.transpose(0, 1).bfloat16()
    assert torch.equal(imagine(weights, start(), rounded)[0], imagine(weights, start(), rounded.float())[0])


def test_pack_returns_none_for_other_sizes_and_precisions(weights):
    odd = ModelConfig(deter_dim=64, hidden_dim=40, decoder_width=20, latent_dim=32, num_bins=31)
    assert weights_of(build(odd)).packed is None
    other = weights._replace(gates=weights.gates.double())
    assert compiled.pack(other, (weights.head, weights.logits, weights.logits_shift)) is None


def test_compiled_rollout_allows_a_latent_wider_than_all_layers(weights):
    sizes = ModelConfig(latent_dim=512, deter_dim=32, hidden_dim=32, decoder_channels=16, decoder_layers=0, num_bins=31)
    wide = weights_of(build(sizes))
    state, actions = State(draw(ROWS, 32).tanh(), draw(ROWS, 512, seed=1)), draw(ROWS, TIME, ACTION, seed=2)
    assert wide.packed is not None
    rewards, last = imagine(wide, state, actions)
    expected, reached = imagine(wide._replace(packed=None), state, actions)
    torch.testing.assert_close(rewards, expected, atol=0.1, rtol=0.1)
    torch.testing.assert_close(last.stoch, reached.stoch, atol=0.1, rtol=0.1)


@pytest.mark.parametrize("wrong", ["actions", "rows", "deter"])
def test_compiled_rollout_raises_for_shapes_that_do_not_fit_the_model(weights, wrong):
    state, actions = start(), draw(ROWS, TIME, ACTION + (wrong == "actions"))
    state = State(state.deter[:, : 32 if wrong == "deter" else 64], state.stoch[: 5 if wrong == "rows" else ROWS])
    with pytest.raises(ValueError, match="deter, stoch and actions have shapes"):
        imagine(weights, state, actions)


def test_compiled_calls_do_not_depend_on_the_default_dtype_and_device(weights, other_defaults):
    state, actions = start(), draw(ROWS, TIME, ACTION, seed=2)

    def call():
        rewards, last = imagine(weights, state, actions)
        return rewards, *last, propose(weights, state, actions), compiled.value(weights.packed, *state)

    expected = call()
    with other_defaults():
        found = call()
    assert all(map(torch.equal, found, expected))


@pytest.mark.parametrize("part", ["deter", "stoch", "actions"])
def test_compiled_calls_refuse_tensors_outside_the_cpu(weights, part):
    given = {**start()._asdict(), "actions": draw(ROWS, TIME, ACTION)}
    given[part] = given[part].to("meta")
    state = State(given["deter"], given["stoch"])
    for call in (imagine, propose):
        with pytest.raises(ValueError, match="needs them on the CPU"):
            call(weights, state, given["actions"])
    if part != "actions":
        with pytest.raises(ValueError, match="needs them on the CPU"):
            compiled.value(weights.packed, *state)
