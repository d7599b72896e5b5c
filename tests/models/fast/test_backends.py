"""Every fast path returns the results of the reference."""

import pytest
import torch
from torch import nn

from latentplan.config import ModelConfig
from latentplan.models import State, WorldModel
from latentplan.models.backend import Backend
from latentplan.models.fast import CpuBackend, GpuBackend, accelerate, library, rollout

ROWS, TIME, ACTION = 70, 4, 3  # three blocks of the compiled rollout, the last one of six rows
SIZES = ModelConfig(
    deter_dim=64,
    hidden_dim=96,
    decoder_width=48,
    latent_dim=32,
    num_bins=31,
    encoder_channels=(8, 8, 12),
    decoder_channels=2,
)

FRAME_SEQUENCES = torch.arange(3 * 2 * 64 * 64 * 3).reshape(3, 2, 64, 64, 3).remainder(251).to(torch.uint8)


def build(backend):
    torch.manual_seed(0)
    model = WorldModel(SIZES, ACTION)
    for name, parameter in model.named_parameters():
        if not name.startswith("encoder"):
            nn.init.normal_(parameter, std=parameter.shape[-1] ** -0.5)
    model.backend = backend
    return model.eval()


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def start(rows=ROWS):
    return State(draw(rows, 64).tanh(), draw(rows, 32, seed=1))


def flat(outputs):
    """Tensors of nested tuples, in order."""
    return [outputs] if isinstance(outputs, torch.Tensor) else [part for each in outputs for part in flat(each)]


def gradients(outputs, inputs):
    """Outputs, and gradients of a scalar in which every number of the outputs has a weight of its own."""
    parts = flat(outputs)
    scalar = sum((part * draw(*part.shape, seed=2)).sum() for part in parts)
    found = torch.autograd.grad(scalar, inputs, allow_unused=True)
    assert any(bool(each.any()) for each in found if each is not None)
    return [*parts, *(torch.zeros(()) if each is None else each for each in found)]


def step(model):
    return model.fast_step(start(), draw(ROWS, ACTION, seed=3).clamp(-1.0, 1.0))


def imagined(model):
    return model.rollout(start(), draw(ROWS, TIME, ACTION, seed=3).clamp(-1.0, 1.0))


def proposed(model):
    return model.backend.propose(model, start(), draw(ROWS, TIME, ACTION, seed=3))


def value(model):
    return model.value(start())


def rollout_gradients(model):
    actions = draw(ROWS, TIME, ACTION, seed=3).clamp(-1.0, 1.0).requires_grad_()
    with torch.enable_grad():
        rewards, last = model.rollout(start(), actions)
        return gradients((rewards, last, model.value(last)), [actions])


def one_frame(rows):
    frames = torch.randint(0, 256, (rows, 64, 64, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(4))

    def decide(model):
        action = draw(rows, ACTION, seed=3).clamp(-1.0, 1.0)
        return model.backend.frame_functions(model).infer_and_act(start(rows), action, frames)

    return decide


def observed(model):
    embeddings, noise = draw(5, TIME + 1, 96, seed=3).requires_grad_(), draw(5, TIME + 1, 32, seed=4)
    actions = draw(5, TIME, ACTION, seed=5).clamp(-1.0, 1.0)
    with torch.enable_grad():
        outputs = model.backend.observe(model, embeddings, actions, draw(5, 64).tanh(), noise)
        return gradients(outputs, [embeddings, *model.dynamics.parameters()])


def predicted(model):
    with torch.enable_grad():
        outputs = model.backend.predict(model, start(5), draw(5, TIME, ACTION, seed=5).clamp(-1.0, 1.0))
        return gradients(outputs, list(model.dynamics.parameters()))


def imagined_by_actor(decay):
    def imagine(model):
        noise = draw(TIME, 5, ACTION, seed=3), draw(TIME, 5, 32, seed=4)
        with torch.enable_grad():
            return gradients(model.backend.imagine(model, start(5), *noise, decay), list(model.actor.parameters()))

    return imagine


def moved(rate):
    def move(model):
        slow, fast = ([draw(3, seed=seed), draw(2, 2, seed=seed)] for seed in (3, 4))
        model.backend.move_towards(slow, fast, rate)
        return slow

    return move


def frames_shifted(model):
    return model.backend.shift_frames(FRAME_SEQUENCES, torch.tensor([[0, 8], [4, 4], [7, 1]]), 4)


def frames_turned(model):
    return model.backend.turn_frames(FRAME_SEQUENCES, torch.tensor([0, 3, 2]))


# Float32 sums in another order differ in their last bits: 1e-5 of a number near 1, and ten times that in a gradient,
# which sums over rows and steps. Rewards are means over bins of up to 8,100, so their last bits are near 1e-3.
EXACT, EXACT_GRADIENT, EXACT_REWARD = 1e-5, 2e-4, 2e-3
FRAMES = {f"{rows} frames": (one_frame(rows), 1e-4) for rows in (1, 5)}  # the first layer scales pixels, not weights
PLANS = {
    "rollout": (imagined, EXACT_REWARD),
    "proposals": (proposed, EXACT),
    "rollout gradients": (rollout_gradients, 2e-3),
}
LEARNING = {
    "observe": (observed, EXACT_GRADIENT),
    "predict": (predicted, EXACT_GRADIENT),
    "imagine": (imagined_by_actor(1.0), EXACT_GRADIENT),
    "imagine, decayed": (imagined_by_actor(0.7), EXACT_GRADIENT),
    "move by a number": (moved(0.25), EXACT),
    "move by a tensor": (moved(torch.tensor(0.25)), EXACT),
}
AUGMENTATION = {"shifted frames": (frames_shifted, 0.0), "turned frames": (frames_turned, 0.0)}
CASES = {CpuBackend: FRAMES | PLANS | AUGMENTATION, GpuBackend: FRAMES | PLANS | LEARNING}


@pytest.mark.parametrize(("kind", "path"), [(kind, path) for kind, paths in CASES.items() for path in paths])
def test_backend_equals_the_reference_in_float32(kind, path):
    call, tolerance = CASES[kind][path]
    fast, plain = build(kind()), build(Backend())
    fast.backend.trunk_dtype = torch.float32
    with torch.no_grad():
        for found, expected in zip(flat(call(fast)), flat(call(plain)), strict=True):
            torch.testing.assert_close(found, expected, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("path", ["compiled", "kernels", "torch"])
@pytest.mark.parametrize("call", [step, imagined, proposed, value])
def test_cpu_backend_is_as_near_to_float32_as_the_reference_in_bfloat16(call, path, monkeypatch):
    """Rounding to bfloat16 happens elsewhere in every path, so only the size of the error can be compared."""
    fast, rounded, exact = build(CpuBackend()), build(Backend(torch.bfloat16)), build(Backend())
    fast.backend.trunk_dtype = torch.bfloat16  # also on a processor where float32 is faster
    with torch.no_grad():
        if path == "compiled" and fast.backend._packed(fast) is None:
            pytest.skip("no compiler, or a processor that multiplies in another precision")
        if path != "compiled":
            monkeypatch.setattr(rollout.compiled, "pack", lambda *_: None)
            fast.backend = CpuBackend()
            fast.backend.trunk_dtype = torch.bfloat16
        if path == "torch":
            monkeypatch.setattr(library, "load", lambda **_: None)
        parts = zip(*(flat(call(model)) for model in (fast, rounded, exact)), strict=True)
        for found, by_reference, truth in parts:
            error, reference_error = ((part - truth).square().mean().sqrt() for part in (found, by_reference))
            assert found.dtype == torch.float32 and 0.0 < error < 1.2 * reference_error


@pytest.mark.parametrize(
    ("features", "dtype"), [("avx2 fma", torch.float32), ("avx512f", torch.float32), ("avx512_bf16", torch.bfloat16)]
)
def test_fast_dtype_is_bfloat16_only_where_the_processor_multiplies_it(features, dtype, monkeypatch):
    monkeypatch.setattr(library, "_describe_processor", lambda: f"flags\t\t: fpu {features} sse")
    assert library.find_fast_dtype.__wrapped__() == dtype


def test_accelerate_chooses_the_backend_of_the_device():
    model = WorldModel(SIZES, ACTION)
    assert type(model.backend) is Backend
    assert accelerate(model) is model and type(model.backend) is CpuBackend
