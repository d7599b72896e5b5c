"""Compiled functions with gradients compute what autograd computes."""

import pytest
import torch

from latentplan.config import ModelConfig
from latentplan.models import State, WorldModel
from latentplan.models.backend import Backend
from latentplan.models.decoder import Decoder
from latentplan.models.dynamics import Rssm
from latentplan.models.encoder import Encoder
from latentplan.models.fast import CpuBackend, native, native_heads, native_pictures, native_unroll
from latentplan.models.heads import Actor, ScalarHead

STEPS = 5
SIZES = {"odd sizes": (7, 5, 11, 13, 3, 17), "sizes of a run": (32, 32, 64, 64, 6, 64)}  # rows, latent, deter, ...


@pytest.fixture(params=[torch.float64, torch.float32], ids=["exact", "rounded"])
def dtype(request):
    """float64, in which compiled functions round nothing, and float32, whose products may round to bfloat16."""
    if native.find_kernels(request.param) is None:
        pytest.skip("no C compiler")
    return request.param


def draw(*shape, seed=0, dtype=torch.float32):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def randomized(module, dtype):
    """The module with random weights and norms, in a format."""
    module = module.to(dtype)
    with torch.no_grad():
        for index, parameter in enumerate(module.parameters()):
            parameter.copy_(draw(*parameter.shape, seed=index, dtype=dtype) * max(parameter.shape[-1], 4) ** -0.5)
            if parameter.dim() == 1:
                parameter.add_(0.5)
    return module


def gradients(outputs, inputs):
    """Outputs, and gradients of a scalar in which every number of the outputs has a weight of its own."""
    scalar = sum((part * draw(*part.shape, seed=20 + i, dtype=part.dtype)).sum() for i, part in enumerate(outputs))
    found = torch.autograd.grad(scalar, inputs, allow_unused=True)
    return [part.detach() for part in outputs] + [part for part in found if part is not None]


def assert_equal(found, expected, dtype):
    """Rounding a factor to eight bits has an error below 0.4 %; roundings in a row add up to a few times that."""
    assert len(found) == len(expected)
    limit = 1e-12 if dtype == torch.float64 else 0.04
    for ours, theirs in zip(found, expected, strict=True):
        assert ours.shape == theirs.shape and ours.dtype == theirs.dtype
        assert (ours - theirs).norm() <= limit * theirs.norm()


def make_dynamics(sizes, dtype):
    _, latent, deter, hidden, action, embedding = sizes
    return randomized(Rssm(latent, deter, hidden, action, embedding), dtype)


@pytest.fixture(params=SIZES.values(), ids=SIZES)
def sizes(request):
    return request.param


def test_observe_equals_autograd(sizes, dtype):
    rows, latent, deter, _, action, embedding = sizes
    dynamics = make_dynamics(sizes, dtype)
    embeddings = draw(rows, STEPS + 1, embedding, dtype=dtype).requires_grad_()
    actions, noise = (
        draw(rows, STEPS, action, seed=1, dtype=dtype).tanh(),
        draw(rows, STEPS + 1, latent, seed=2, dtype=dtype),
    )
    given = embeddings, actions, draw(rows, deter, seed=3, dtype=dtype).tanh(), noise
    results = []
    for states, posterior in (native_unroll.observe(dynamics, *given), dynamics.observe(*given)):
        results.append(gradients([*states, *posterior], [embeddings, *dynamics.parameters()]))
    assert_equal(*results, dtype)


def test_predict_equals_autograd(sizes, dtype):
    rows, latent, deter, _, action, _ = sizes
    dynamics = make_dynamics(sizes, dtype)
    start = State(draw(rows, deter, dtype=dtype).tanh(), draw(rows, latent, seed=1, dtype=dtype))
    actions = draw(rows, STEPS, action, seed=2, dtype=dtype).tanh()
    results = []
    for deters, prior in (native_unroll.predict(dynamics, start, actions), dynamics.predict(start, actions)):
        results.append(gradients([deters, *prior], list(dynamics.parameters())))
    assert_equal(*results, dtype)


@pytest.mark.parametrize("decay", [1.0, 0.7])
def test_imagine_equals_autograd(sizes, dtype, decay):
    rows, latent, deter, hidden, action, _ = sizes
    dynamics = make_dynamics(sizes, dtype).requires_grad_(False)
    actor = randomized(Actor(deter + latent, hidden, action), dtype)
    start = State(draw(rows, deter, dtype=dtype).tanh(), draw(rows, latent, seed=1, dtype=dtype))
    noise = draw(STEPS, rows, action, seed=2, dtype=dtype), draw(STEPS, rows, latent, seed=3, dtype=dtype)
    found = native_unroll.imagine(dynamics, actor, start, *noise, decay)
    expected = dynamics.imagine(actor, start, *noise, decay)
    assert_equal(*(gradients(each, list(actor.parameters())) for each in (found, expected)), dtype)


def test_head_equals_autograd(sizes, dtype):
    rows, inputs, hidden, *_ = sizes
    head = randomized(ScalarHead(inputs, hidden, 31), dtype)
    features = draw(3, rows, inputs, dtype=dtype).requires_grad_()
    targets = 20.0 * draw(3, rows, seed=1, dtype=dtype)
    logits = native_heads.apply(head.mlp, features)
    found = logits, native_heads.mean(head, logits), native_heads.cross_entropy(head, logits, targets)
    logits = head(features)
    expected = logits, head.mean(logits), head.loss(logits, targets)
    wanted = [features, *head.parameters()]
    assert_equal(*(gradients(each, wanted) for each in (found, expected)), dtype)


def test_frozen_head_passes_the_gradient_of_its_features_alone(dtype):
    head = randomized(ScalarHead(9, 21, 31), dtype).requires_grad_(False)
    features = draw(40, 9, dtype=dtype).requires_grad_()
    results = [gradients([each], [features]) for each in (native_heads.apply(head.mlp, features), head(features))]
    assert_equal(*results, dtype)


def test_lambda_return_equals_autograd(dtype):
    parts = [draw(STEPS, 3, 5, seed=seed, dtype=dtype).requires_grad_() for seed in range(3)]
    results = [
        gradients([compute(*parts, 0.9)], parts) for compute in (native_heads.lambda_return, Backend().lambda_return)
    ]
    assert_equal(*results, dtype)


@pytest.mark.parametrize("channels", [(32, 48, 64), (5, 7), (8,), (3, 4, 5, 6, 7)])
@pytest.mark.parametrize("rows", [3, 37])
def test_encoder_equals_autograd(channels, rows, dtype):
    encoder = randomized(Encoder(channels, 13), dtype)
    frames = torch.randint(0, 256, (rows, 64, 64, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    results = [
        gradients([embeddings], list(encoder.parameters()))
        for embeddings in (native_pictures.encode(encoder, frames), encoder(frames))
    ]
    assert_equal(*results, dtype)


@pytest.mark.parametrize(("inputs", "channels", "layers"), [(10, 3, 0), (64, 16, 0), (10, 3, 2)])
def test_reconstruction_errors_equal_autograd(inputs, channels, layers, dtype):
    decoder = randomized(Decoder(inputs, channels, hidden_dim=12, layers=layers), dtype)
    features = draw(35, inputs, dtype=dtype).requires_grad_()
    frames = torch.randint(0, 256, (35, 64, 64, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    found = native_pictures.reconstruction_errors(decoder, features, frames)
    expected = decoder.loss(decoder(features), frames)
    wanted = [features, *decoder.parameters()]
    assert_equal(*(gradients([each], wanted) for each in (found, expected)), dtype)


def make_calls(dtype):
    """A call of each function with one number that spoils its second row or picture, if it is not finite."""
    sizes = SIZES["sizes of a run"]
    rows, latent, deter, hidden, action, embedding = sizes
    dynamics, actor = make_dynamics(sizes, dtype), randomized(Actor(deter + latent, hidden, action), dtype)
    head, decoder = randomized(ScalarHead(deter, hidden, 31), dtype), randomized(Decoder(deter, 4), dtype)
    frames = torch.zeros(rows, 64, 64, 3, dtype=torch.uint8)
    moves, noise = draw(rows, STEPS, action, dtype=dtype).tanh(), draw(STEPS, rows, action, dtype=dtype)

    def spoiled(number):
        states = draw(rows, deter, dtype=dtype)
        states[1, 2] = number
        return states

    def start(number):
        return State(spoiled(number), draw(rows, latent, dtype=dtype))

    embeddings, draws = draw(rows, STEPS + 1, embedding, dtype=dtype), draw(rows, STEPS + 1, latent, dtype=dtype)
    return {
        "observe": lambda number: native_unroll.observe(dynamics, embeddings, moves, spoiled(number), draws)[0].stoch,
        "predict": lambda number: native_unroll.predict(dynamics, start(number), moves)[0],
        "imagine": lambda number: native_unroll.imagine(
            dynamics, actor, start(number), noise, draw(STEPS, rows, latent, dtype=dtype), 1.0
        )[0].transpose(0, 1),
        "apply": lambda number: native_heads.apply(head.mlp, spoiled(number)),
        "mean": lambda number: native_heads.mean(head, spoiled(number)[:, :31]),
        "cross-entropy": lambda number: native_heads.cross_entropy(head, spoiled(number)[:, :31], spoiled(0.0)[:, 40]),
        "target": lambda number: native_heads.cross_entropy(head, spoiled(0.0)[:, :31], spoiled(number)[:, 2]),
        "reconstruction": lambda number: native_pictures.reconstruction_errors(decoder, spoiled(number), frames),
    }


@pytest.mark.parametrize("name", make_calls(torch.float32))
def test_nan_makes_its_own_row_nan_and_no_other(name, dtype):
    call = make_calls(dtype)[name]
    with torch.no_grad():
        clean, dirty = call(0.5), call(float("nan"))
    others = [0, *range(2, len(clean))]
    assert clean.isfinite().all() and dirty[1].isnan().any()
    assert torch.equal(clean[others], dirty[others])


def test_results_do_not_depend_on_the_number_of_threads(dtype):
    sizes = (80, 32, 64, 64, 6, 64)
    rows, latent, deter, hidden, action, embedding = sizes
    dynamics, head = make_dynamics(sizes, dtype), randomized(ScalarHead(deter, hidden, 31), dtype)
    embeddings = draw(rows, STEPS + 1, embedding, dtype=dtype).requires_grad_()
    features = draw(rows, deter, dtype=dtype).requires_grad_()
    rest = draw(rows, STEPS, action, dtype=dtype).tanh(), draw(rows, deter, dtype=dtype)
    noise, results, threads = draw(rows, STEPS + 1, latent, dtype=dtype), [], torch.get_num_threads()
    norms = [dynamics.gates_norm.weight, head.mlp.trunk[0].norm.bias]
    for count in (1, 2):
        torch.set_num_threads(count)
        states, posterior = native_unroll.observe(dynamics, embeddings, *rest, noise)
        parts = [*states, *posterior, native_heads.apply(head.mlp, features)]
        results.append(gradients(parts, [embeddings, features, *norms]))
    torch.set_num_threads(threads)
    assert all(torch.equal(one, two) for one, two in zip(*results, strict=True))


def test_torch_computes_where_there_are_no_kernels(model, frames, monkeypatch):
    monkeypatch.setattr(native, "find_kernels", lambda real: None)
    fast, plain = CpuBackend(), Backend()
    features = draw(5, 56)
    pairs = [
        (backend.encode(model, frames), backend.apply(model.continue_head, features),
         backend.mean(model.value_head, draw(5, 31)), backend.reconstruction_errors(model, features, frames),
         backend.lambda_return(draw(3, 5), draw(3, 5, seed=1), draw(3, 5, seed=2), 0.9))
        for backend in (fast, plain)
    ]  # fmt: skip
    assert all(torch.equal(ours, theirs) for ours, theirs in zip(*pairs, strict=True))
    assert fast.frozen_dtype(model) == fast.trunk_dtype


def test_default_sizes_fit_the_compiled_functions():
    """A change that makes `fits` refuse the default sizes would only show in speed."""
    if native.find_kernels(torch.float32) is None:
        pytest.skip("no C compiler")
    model = WorldModel(ModelConfig(), 6)
    assert all(map(native.fits, (model.dynamics, model.actor, model.reward_head, model.continue_head)))
    assert native_pictures.can_encode(model.encoder) and native_pictures.can_encode(model.decoder)


def test_second_backward_pass_is_refused_because_the_arrays_were_given_back(dtype):
    head = randomized(ScalarHead(9, 21, 31), dtype)
    total = native_heads.apply(head.mlp, draw(20, 9, dtype=dtype)).sum()
    total.backward(retain_graph=True)
    with pytest.raises(RuntimeError, match="once only"):
        total.backward()


def test_arrays_of_one_update_serve_the_next(dtype):
    decoder = randomized(Decoder(10, 3), dtype)
    frames = torch.zeros(5, 64, 64, 3, dtype=torch.uint8)
    results = []
    for seed in (0, 1, 0):
        features = draw(5, 10, seed=seed, dtype=dtype).requires_grad_()
        results.append(gradients([native_pictures.reconstruction_errors(decoder, features, frames)], [features]))
    first, _, again = results
    assert all(torch.equal(one, two) for one, two in zip(first, again, strict=True))
    assert sum(map(len, native._spare.values())) <= native.MOST_SPARE * len(native._spare)


def test_inputs_of_another_shape_are_refused_before_compiled_code_reads_them(dtype):
    sizes = SIZES["odd sizes"]
    rows, latent, deter, hidden, action, embedding = sizes
    dynamics, head = make_dynamics(sizes, dtype), randomized(ScalarHead(deter, hidden, 31), dtype)
    encoder, decoder = randomized(Encoder((4, 4), 8), dtype), randomized(Decoder(deter, 3), dtype)
    start = State(draw(rows, deter, dtype=dtype), draw(rows, latent, dtype=dtype))
    frames, logits = torch.zeros(rows, 64, 64, 3, dtype=torch.uint8), draw(rows, 31, dtype=dtype)
    wrong = draw(rows, deter + 1, dtype=dtype)
    values = draw(STEPS, rows, dtype=dtype)
    calls = [
        lambda: native_unroll.predict(dynamics, start, draw(rows, STEPS, action + 1, dtype=dtype)),
        lambda: native_unroll.predict(dynamics, State(wrong, start.stoch), draw(rows, STEPS, action, dtype=dtype)),
        lambda: native_unroll.predict(dynamics, start, draw(rows + 1, STEPS, action, dtype=dtype)),
        lambda: native_heads.apply(head.mlp, wrong),
        lambda: native_heads.mean(head, logits[:, :-1]),
        lambda: native_heads.cross_entropy(head, logits, draw(rows + 1, dtype=dtype)),
        lambda: native_heads.lambda_return(values, values, values[:, :-1], 0.9),
        lambda: native_pictures.encode(encoder, frames[:, :-1]),
        lambda: native_pictures.encode(encoder, frames.float()),
        lambda: native_pictures.reconstruction_errors(decoder, wrong, frames),
        lambda: native_pictures.reconstruction_errors(decoder, start.deter, frames[:-1]),
    ]
    for call in calls:
        with pytest.raises(ValueError, match="shape|uint8"):
            call()


def test_arrays_of_compiled_functions_lie_on_the_cpu_whatever_the_default_device(dtype):
    rows, latent, deter, _, action, embedding = sizes = SIZES["sizes of a run"]
    dynamics, head = make_dynamics(sizes, dtype), randomized(ScalarHead(deter, 40, 31), dtype)
    actor, frames = randomized(Actor(deter + latent, 40, action), dtype), torch.zeros(rows, 64, 64, 3).byte()
    encoder, decoder = randomized(Encoder((4, 4), embedding), dtype), randomized(Decoder(deter, 3), dtype)
    start = State(draw(rows, deter, dtype=dtype), draw(rows, latent, dtype=dtype))
    moves, noise = draw(rows, 1, action, dtype=dtype).tanh(), draw(rows, 2, latent, dtype=dtype)

    def compute():
        native._spare.clear()
        embeddings = native_pictures.encode(encoder, frames)[:, None].expand(-1, 2, -1)
        imagined = moves.transpose(0, 1), noise[:, :1].transpose(0, 1)
        features, _ = native_unroll.imagine(dynamics, actor, start, *imagined, 1.0)
        parts = (
            native_unroll.observe(dynamics, embeddings, moves, start.deter, noise)[0].stoch,
            native_unroll.predict(dynamics, start, moves)[0],
            features,
            native_heads.apply(head.mlp, start.deter),
            native_pictures.reconstruction_errors(decoder, start.deter, frames),
        )
        weights = [weight for part in (encoder, dynamics, actor, head, decoder) for weight in part.parameters()]
        found = torch.autograd.grad(sum(part.sum() for part in parts), weights, allow_unused=True)
        return [part.detach() for part in parts] + [part for part in found if part is not None]

    expected = compute()
    with torch.device("meta"):
        found = compute()
    assert all(map(torch.equal, found, expected))


def test_inputs_outside_the_cpu_are_refused_before_compiled_code_reads_them(dtype):
    sizes = SIZES["odd sizes"]
    rows, latent, deter, hidden, action, embedding = sizes
    dynamics, head = make_dynamics(sizes, dtype), randomized(ScalarHead(deter, hidden, 31), dtype)
    encoder, decoder = randomized(Encoder((4, 4), 8), dtype), randomized(Decoder(deter, 3), dtype)
    start = State(draw(rows, deter, dtype=dtype), draw(rows, latent, dtype=dtype))
    frames, logits, far = torch.zeros(rows, 64, 64, 3).byte(), draw(rows, 31, dtype=dtype), start.deter.to("meta")
    actions, values = draw(rows, STEPS, action, dtype=dtype), draw(STEPS, rows, dtype=dtype)
    embeddings, noise = (draw(rows, STEPS + 1, size, dtype=dtype) for size in (embedding, latent))
    calls = [
        lambda: native_unroll.predict(dynamics, State(far, start.stoch), actions),
        lambda: native_unroll.predict(dynamics, start, actions.to("meta")),
        lambda: native_unroll.observe(dynamics, embeddings.to("meta"), actions, start.deter, noise),
        lambda: native_unroll.observe(dynamics, embeddings, actions, start.deter, noise.to("meta")),
        lambda: native_heads.apply(head.mlp, far),
        lambda: native_heads.mean(head, logits.to("meta")),
        lambda: native_heads.cross_entropy(head, logits, draw(rows, dtype=dtype).to("meta")),
        lambda: native_heads.lambda_return(values.to("meta"), values, values, 0.9),
        lambda: native_heads.lambda_return(values, values, values.to("meta"), 0.9),
        lambda: native_pictures.encode(encoder, frames.to("meta")),
        lambda: native_pictures.reconstruction_errors(decoder, far, frames),
        lambda: native_pictures.reconstruction_errors(decoder, start.deter, frames.to("meta")),
    ]
    for call in calls:
        with pytest.raises(ValueError, match="on device meta"):
            call()
