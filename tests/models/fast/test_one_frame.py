"""Decisions about single frames: the compiled path and the path by calls of torch, against the reference."""

import copy
import platform
from pathlib import Path

import numpy as np
import pytest
import torch

from latentplan.agents.actor import ActorAgent
from latentplan.config import Config, ModelConfig
from latentplan.models import State, WorldModel
from latentplan.models.backend import Backend, FrameFunctions
from latentplan.models.fast import CpuBackend, library, native_frame
from latentplan.models.fast.backends import ConvertedWeights
from latentplan.models.fast.native_frame import NativeFrameFunctions
from latentplan.models.fast.one_frame import TorchFrameFunctions

PATHS = [NativeFrameFunctions, TorchFrameFunctions]
ACTION = 3


def make_model(channels=(8, 12, 16), deter=24, hidden=20, latent=32, seed=0):
    torch.manual_seed(seed)
    config = ModelConfig(latent, deter, hidden, encoder_channels=channels, decoder_channels=2, num_bins=15)
    model = WorldModel(config, ACTION).eval()
    with torch.no_grad():
        for parameter in model.parameters():  # norms and shifts away from ones and zeros
            parameter.add_(0.1 * torch.randn(parameter.shape))
    return model


def make_functions(path, model):
    """The functions of a path for a model; skips the test where the path cannot be taken."""
    if path is NativeFrameFunctions and not path.can_pack(model):
        pytest.skip("no C compiler")
    return path(model)


def frames_of(rows, seed=0):
    return torch.from_numpy(np.random.default_rng(seed).integers(0, 256, (rows, 64, 64, 3), dtype=np.uint8))


def inputs_of(rows, model, seed=0):
    """Beliefs, actions and frames."""
    generator, sizes = torch.Generator().manual_seed(seed), model.config
    draws = [torch.randn(rows, size, generator=generator) for size in (sizes.deter_dim, sizes.latent_dim, ACTION)]
    return State(draws[0].tanh(), draws[1]), draws[2].tanh(), frames_of(rows, seed)


def call_all(functions, state, action, frames, is_first=None):
    """All results, by name."""
    belief, mean, std = functions.infer_and_act(state, action, frames, is_first)
    compared, mismatch = functions.infer_and_compare(state, action, frames, is_first)
    names = ("mean", "std", "mismatch", "surprise")
    results = dict(zip(names, (mean, std, mismatch, functions.surprise(state)), strict=True))
    beliefs = {
        "belief": belief,
        "compared": compared,
        "alone": functions.infer(state, action, frames, is_first),
        "first": functions.infer(state, None, frames, is_first),
    }
    for name, each in beliefs.items():
        results |= {f"{name} deter": each.deter, f"{name} stoch": each.stoch}
    return results | dict(zip(("acted mean", "acted std"), functions.act(state), strict=True))


def assert_near(found, expected):
    for name, value in expected.items():
        # Sums in another order differ in their last bits; mismatch and surprise are squares of differences near 1.
        tolerance = 1e-4 if name in ("mismatch", "surprise") or "stoch" in name else 1e-5
        torch.testing.assert_close(
            found[name], value, rtol=tolerance, atol=tolerance, msg=lambda m, n=name: f"{n}: {m}"
        )


SIZES = [
    {"channels": (8,)},
    {"channels": (8, 12), "deter": 7, "hidden": 33},
    {"channels": (32, 48, 64), "deter": 64, "hidden": 48},
    {"channels": (16, 20, 4, 8), "latent": 5},
    {"channels": (4, 6, 8, 10, 12), "hidden": 3, "latent": 40},
]


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("sizes", SIZES)
@pytest.mark.parametrize("rows", [1, 2, 3, 4, 5])
def test_path_equals_the_reference_for_every_size(path, sizes, rows):
    model = make_model(**sizes)
    functions, inputs = make_functions(path, model), inputs_of(rows, model)
    is_first = torch.arange(rows) % 2 == 1
    with torch.no_grad():
        for flags in (None, is_first):
            assert_near(call_all(functions, *inputs, flags), call_all(FrameFunctions(model), *inputs, flags))


@pytest.mark.parametrize("path", PATHS)
def test_path_equals_the_model_for_an_ordinary_belief(path):
    model = make_model()
    functions, (state, action, frames) = make_functions(path, model), inputs_of(2, model)
    with torch.no_grad():
        expected = model.infer(state, action, frames)
        belief, mean, _ = functions.infer_and_act(state, action, frames)
        torch.testing.assert_close(belief, expected, atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(mean, model.actor(expected.features)[0], atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(functions.surprise(state), model.surprise(state), atol=1e-4, rtol=1e-4)


@pytest.fixture
def native():
    """The compiled functions of a model, and inputs of nine rows: two blocks and one row."""
    model = make_model()
    return make_functions(NativeFrameFunctions, model), inputs_of(9, model)


def rows_of(inputs, rows):
    state, action, frames = inputs
    return State(*(part[rows] for part in state)), action[rows], frames[rows]


def test_compiled_decision_computes_each_row_independently(native):
    functions, inputs = native
    whole = call_all(functions, *inputs)
    for rows in (slice(0, 1), slice(3, 8), slice(6, 9)):
        part = call_all(functions, *rows_of(inputs, rows))
        assert all(torch.equal(whole[name][rows], part[name]) for name in whole)


def test_compiled_decision_does_not_depend_on_the_number_of_threads(native):
    functions, inputs = native
    before, results = torch.get_num_threads(), []
    for threads in (1, 3, 12):
        torch.set_num_threads(threads)
        results.append(call_all(functions, *inputs))
    torch.set_num_threads(before)
    assert all(torch.equal(results[0][name], other[name]) for other in results[1:] for name in other)


def test_compiled_decision_of_no_rows_is_empty(native):
    functions, inputs = native
    results = call_all(functions, *rows_of(inputs, slice(0, 0)))
    assert all(len(each) == 0 for each in results.values())


@pytest.mark.parametrize("part", ["deter", "stoch", "action"])
def test_compiled_decision_keeps_nan_in_its_row(native, part):
    functions, (state, action, frames) = native
    {"deter": state.deter, "stoch": state.stoch, "action": action}[part][4, 2] = float("nan")
    belief, mean, std = functions.infer_and_act(state, action, frames)
    _, mismatch = functions.infer_and_compare(state, action, frames)
    others = [row for row in range(9) if row != 4]
    for each in (*belief, mean, std, mismatch):
        assert each[4].isnan().all() and each[others].isfinite().all()
    surprise = functions.surprise(state)
    assert bool(surprise[4].isnan()) == (part != "action") and surprise[others].isfinite().all()


@pytest.mark.parametrize(
    "name", ["encoder.patches.weight", "encoder.convolutions.1.bias", "encoder.linear.weight", "dynamics.gates.weight"]
)
def test_compiled_decision_is_nan_where_a_weight_is_nan(name):
    model = make_model()
    with torch.no_grad():
        model.get_parameter(name).view(-1)[1] = float("nan")
    belief, mean, std = make_functions(NativeFrameFunctions, model).infer_and_act(*inputs_of(2, model))
    assert all(each.isnan().all() for each in (belief.stoch, mean, std))


def test_first_frame_of_an_episode_forgets_even_nan(native):
    functions, (state, action, frames) = native
    state.deter[4] = float("nan")
    belief = functions.infer(state, action, frames, torch.arange(9) == 4)
    assert belief.deter[4].count_nonzero() == 0 and belief.stoch.isfinite().all()


def test_compiled_decision_leaves_its_inputs_unchanged(native):
    functions, inputs = native
    copies = copy.deepcopy(inputs)
    call_all(functions, *inputs, torch.arange(9) == 4)
    assert all(map(torch.equal, (*inputs[0], *inputs[1:]), (*copies[0], *copies[1:])))


def test_compiled_decision_accepts_views_and_other_precisions(native):
    functions, (state, action, frames) = native
    action = action.bfloat16()
    expected = functions.infer(state, action.float(), frames)
    views = [part.t().contiguous().t() for part in state]
    turned = frames.transpose(1, 2).contiguous().transpose(1, 2)
    found = functions.infer(State(views[0].double(), views[1]), action, turned)
    assert all(map(torch.equal, found, expected))


@pytest.mark.parametrize("wrong", ["deter", "stoch", "action", "frames", "dtype", "is_first"])
def test_compiled_decision_raises_for_inputs_that_do_not_fit_the_model(native, wrong):
    functions, (state, action, frames) = native
    is_first = torch.zeros(8 if wrong == "is_first" else 9, dtype=torch.bool)
    if wrong in ("deter", "stoch"):
        state = state._replace(**{wrong: getattr(state, wrong)[:, 1:]})
    action = action[:8] if wrong == "action" else action
    frames = frames[:, :32] if wrong == "frames" else frames.float() if wrong == "dtype" else frames
    with pytest.raises(ValueError, match="the model needs"):
        functions.infer(state, action, frames, is_first)


def test_compiled_decision_does_not_depend_on_the_default_dtype_and_device(native, other_defaults):
    functions, inputs = native
    expected = call_all(functions, *inputs)
    with other_defaults():
        found = call_all(functions, *inputs)
    assert all(torch.equal(found[name], expected[name]) for name in expected)


@pytest.mark.parametrize("part", ["deter", "stoch", "action", "frames", "is_first"])
def test_compiled_decision_refuses_tensors_outside_the_cpu(native, part):
    functions, (state, action, frames) = native
    given = dict(deter=state.deter, stoch=state.stoch, action=action, frames=frames, is_first=torch.arange(9) == 4)
    given[part] = given[part].to("meta")
    with pytest.raises(ValueError, match="on device meta; the model needs"):
        functions.infer(State(given["deter"], given["stoch"]), given["action"], given["frames"], given["is_first"])


def run_on(march):
    """Whether this machine runs code for an architecture of the x86-64 family."""
    flags = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    return platform.machine() == "x86_64" and (
        march == "x86-64" or all(f" {each} " in flags for each in ("avx2", "fma"))
    )


@pytest.mark.parametrize("march", ["x86-64", "x86-64-v3"])
def test_compiled_decision_equals_the_reference_on_older_processors(native, march, tmp_path, monkeypatch):
    if not run_on(march):
        pytest.skip(f"the machine does not run code for {march}")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    older = library._compile(("frame.c",), [f"-march={march}"])
    older.decide.argtypes = library.load().decide.argtypes
    monkeypatch.setattr(native_frame, "load", lambda: older)
    model, (_, inputs) = make_model((32, 48, 64)), native
    with torch.no_grad():
        assert_near(call_all(NativeFrameFunctions(model), *inputs), call_all(FrameFunctions(model), *inputs))


def path_of(model):
    return type(CpuBackend().frame_functions(model))


def test_cpu_backend_takes_the_compiled_path_unless_it_is_missing(monkeypatch):
    model = make_model()
    if NativeFrameFunctions.can_pack(model):
        assert path_of(model) is NativeFrameFunctions
    assert path_of(model.double()) is TorchFrameFunctions
    monkeypatch.setattr(native_frame, "load", lambda: None)
    assert path_of(make_model()) is TorchFrameFunctions


def test_cpu_backend_shares_weights_whose_changes_torch_does_not_count():
    with torch.inference_mode():
        model = make_model()
        before = CpuBackend().frame_functions(model).act(inputs_of(1, model)[0])
        model.actor.mlp.output.bias.add_(1.0)
        assert not torch.equal(CpuBackend().frame_functions(model).act(inputs_of(1, model)[0])[0], before[0])
    assert path_of(model) is TorchFrameFunctions


def load_other_weights(model):
    model.load_state_dict(make_model(seed=1).state_dict())


def descend(model):
    optimizer = torch.optim.Adam(model.parameters(), lr=0.1, fused=True)
    state = model.see(torch.zeros(2, 24), frames_of(2))
    rewards = model.reward_head(state.features)
    sum(part.sum() for part in (*model.actor(state.features), rewards)).backward()
    optimizer.step()


@pytest.fixture(params=["compiled", "torch"])
def cpu_model(request, monkeypatch):
    """A model with the backend for processors, with and without compiled calls."""
    model = make_model()
    if request.param == "torch":
        monkeypatch.setattr(native_frame, "load", lambda: None)
    model.backend = CpuBackend()
    return model


@pytest.mark.parametrize("change", [load_other_weights, descend])
def test_agent_uses_weights_that_changed_between_two_frames(cpu_model, change):
    agent, frames = ActorAgent(cpu_model, Config()), frames_of(2)
    action = torch.from_numpy(agent.act(frames.numpy()))
    before = agent.state
    change(cpu_model)
    after = agent.act(frames.numpy())
    with torch.no_grad():
        expected = cpu_model.infer(before, action, frames)
        assert torch.allclose(agent.state.stoch, expected.stoch, atol=1e-4)
        assert np.allclose(after, cpu_model.actor(expected.features)[0].numpy(), atol=1e-4)


@pytest.mark.parametrize("change", [load_other_weights, descend])
def test_rollouts_use_weights_that_changed_between_two_calls(cpu_model, change):
    state, actions = State(torch.zeros(1, 24), torch.zeros(1, 32)), torch.zeros(1, 4, ACTION)
    with torch.no_grad():
        before, _ = cpu_model.rollout(state, actions)
    change(cpu_model)
    with torch.no_grad():
        after, _ = cpu_model.rollout(state, actions)
        expected, _ = CpuBackend().rollout(cpu_model, state, actions)
    assert torch.equal(after, expected) and not torch.equal(after, before)


def test_backend_changes_no_weight():
    model, same = make_model(), make_model()
    CpuBackend().frame_functions(model).act(State(torch.zeros(1, 24), torch.zeros(1, 32)))
    assert all(torch.equal(ours, theirs) for ours, theirs in zip(model.parameters(), same.parameters(), strict=True))


def test_copy_of_a_model_decides_with_its_own_weights():
    model = make_model()
    model.backend = CpuBackend()
    state = inputs_of(1, model)[0]
    expected = model.backend.frame_functions(model).act(state)
    twin = copy.deepcopy(model)
    load_other_weights(model)
    assert all(map(torch.equal, twin.backend.frame_functions(twin).act(state), expected))
    plain = Backend().frame_functions(model).act(state)[0]
    torch.testing.assert_close(model.backend.frame_functions(model).act(state)[0], plain, atol=1e-5, rtol=1e-5)


def test_agent_checks_the_weights_once_per_decision(monkeypatch):
    model, checks, check = make_model(), [], ConvertedWeights.of
    model.backend = CpuBackend()
    agent, frames = ActorAgent(model, Config()), frames_of(2).numpy()
    agent.act(frames)
    monkeypatch.setattr(ConvertedWeights, "of", lambda *arguments: checks.append(1) or check(*arguments))
    agent.act(frames)
    assert len(checks) == 1


def test_model_made_in_inference_mode_decides_outside_it():
    with torch.inference_mode():
        model = make_model()
    state, action, frames = inputs_of(2, model)
    with torch.no_grad():
        found = CpuBackend().frame_functions(model).infer(state, action, frames)
        expected = FrameFunctions(model).infer(state, action, frames)
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-4)
