"""Compiled kernels compute what torch computes, and torch computes where they are missing."""

import pytest
import torch

from latentplan.models.fast import library

DTYPES = [torch.bfloat16, torch.float32]
ROWS, SIZE = 37, 45  # neither is a multiple of a vector's length


@pytest.fixture
def compiled():
    """Skips a test where the kernels cannot be compiled."""
    if library.load() is None:
        pytest.skip("no C compiler")


def draw(*shape, dtype=torch.float32, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed)).to(dtype)


def norm(size):
    return 1.0 + 0.3 * draw(size, seed=1), 0.3 * draw(size, seed=2)


def make_call(name, dtype):
    """A function that calls a kernel with the same input every time, for some rows."""
    if name == "norm_silu":
        return lambda row=slice(None): (library.norm_silu(4.0 * draw(ROWS, SIZE, dtype=dtype)[row] + 1.0, norm(SIZE)),)
    if name == "gates":
        product, deter = draw(ROWS, 3 * SIZE, dtype=dtype), draw(ROWS, SIZE, seed=3)
        return lambda row=slice(None): library.gates(product[row], norm(3 * SIZE), deter[row])
    logits = 5.0 * draw(ROWS, SIZE)
    return lambda row=slice(None): (library.expectation(logits[row], 10.0 * draw(SIZE, seed=4)),)


CASES = [(name, dtype) for name in ("norm_silu", "gates") for dtype in DTYPES] + [("expectation", torch.float32)]


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize(("name", "dtype"), CASES)
def test_compiled_kernel_equals_torch(name, dtype, monkeypatch):
    call = make_call(name, dtype)
    fused = call()
    monkeypatch.setattr(library, "load", lambda: None)
    for left, right in zip(fused, call(), strict=True):
        assert left.dtype == right.dtype and left.shape == right.shape
        precision = 2e-2 if left.dtype == torch.bfloat16 else 2e-5
        assert torch.allclose(left.float(), right.float(), rtol=precision, atol=precision)


@pytest.mark.parametrize(("name", "dtype"), CASES)
def test_kernel_computes_each_row_independently(name, dtype):
    call = make_call(name, dtype)
    for whole, part in zip(call(), call(slice(5, 6)), strict=True):
        # Torch takes the end of a tensor another way than its middle, which shows in the last bit.
        assert (
            torch.equal(whole[5:6], part) if library.load() else torch.allclose(whole[5:6], part, rtol=1e-2, atol=1e-6)
        )


@pytest.mark.parametrize("dtype", DTYPES)
def test_kernel_keeps_nan_in_its_row(dtype):
    product, wide, logits = draw(3, SIZE, dtype=dtype), draw(3, 3 * SIZE, dtype=dtype), draw(3, SIZE)
    for rows in (product, wide, logits):
        rows[1, 7] = float("nan")
    results = (
        library.norm_silu(product, norm(SIZE)),
        *library.gates(wide, norm(3 * SIZE), draw(3, SIZE)),
        library.expectation(logits, draw(SIZE)).unsqueeze(-1),
    )
    for result in results:
        assert result[1].isnan().all()
        assert result[[0, 2]].isfinite().all()


def test_kernel_saturates_for_extreme_inputs():
    far = torch.tensor([[3e38, -3e38, 0.0], [200.0, -200.0, 0.0]])
    assert library.expectation(far, torch.tensor([1.0, 2.0, 3.0])).tolist() == [1.0, 1.0]
    following, _ = library.gates(draw(4, 6) * 1e4, (torch.full((6,), 1e4), torch.zeros(6)), draw(4, 2))
    assert following.isfinite().all()


def test_expectation_uses_torch_for_bfloat16_logits():
    logits, values = draw(3, 5, dtype=torch.bfloat16), draw(5, dtype=torch.bfloat16)
    assert torch.equal(library.expectation(logits, values), logits.softmax(-1) @ values)
    with pytest.raises(RuntimeError):
        library.expectation(logits, values.float())  # as torch has it; the kernel would read beyond the end


def test_kernel_passes_gradients_when_inputs_require_them():
    product, deter = draw(4, 6).requires_grad_(), draw(4, 2).requires_grad_()
    before = product.detach().clone()
    following, _ = library.gates(product, norm(6), deter)
    (following.sum() + library.norm_silu(product, norm(6)).sum()).backward()
    assert product.grad.abs().sum() > 0.0 and deter.grad.abs().sum() > 0.0
    assert torch.equal(product, before)


@pytest.mark.parametrize("settings", [{"CC": "false"}, {"CC": "/nowhere/cc"}, {"LATENTPLAN_KERNELS": "0"}])
def test_load_returns_none_without_a_working_compiler_and_says_so_once(settings, tmp_path, monkeypatch, caplog):
    monkeypatch.delenv("LATENTPLAN_KERNELS", raising=False)
    for name, value in {"XDG_CACHE_HOME": str(tmp_path), **settings}.items():
        monkeypatch.setenv(name, value)
    library._say_slower.cache_clear()
    assert [library.load.__wrapped__() for _ in range(2)] == [None, None]
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) == ("CC" in settings)  # who switches the kernels off knows
    assert all("torch computes instead, slower" in line and "\n" not in line for line in lines)


@pytest.mark.usefixtures("compiled")
def test_load_returns_none_without_a_home_directory(monkeypatch):
    def unknown_home():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(library.Path, "home", unknown_home)
    assert library.load.__wrapped__() is None
