"""What all compiled functions with gradients share: their number formats, their layers, and padding of rows."""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from latentplan.models.fast.library import load

TILE = 16  # as in products.h: numbers of rows are multiples of this
MULTIPLE = 32  # padded sizes are multiples of this
LONGEST_ROW = 4096  # as in layers.h
MOST_SPARE = 16  # arrays of one shape
CPU = torch.device("cpu")
HALVES = {2: torch.bfloat16, 4: torch.float32, 8: torch.float64}

Place = ctypes.c_void_p
Count = ctypes.c_long


class Layer(ctypes.Structure):
    """A linear layer and its norm, as in layers.h."""

    _fields_ = (("weights", Place), ("scale", Place), ("shift", Place), ("inputs", Count), ("outputs", Count))


class Kernels(NamedTuple):
    """The compiled functions of one number format.

    Attributes:
        library: The compiled library.
        real: Format of sums and of elementwise work; every tensor that a function takes has it.
        half: Format of the factors of products.
    """

    library: ctypes.CDLL
    real: torch.dtype
    half: torch.dtype


@functools.cache
def find_kernels(real: torch.dtype) -> Kernels | None:
    """The compiled functions for weights of a format; None if there are none.

    Args:
        real: float32, or float64 to compute without rounding to other formats.
    """
    library = load(is_exact=real == torch.float64) if real in (torch.float32, torch.float64) else None
    size = 0 if library is None else library.size_of_half()
    return None if library is None or size == 0 else Kernels(library, real, HALVES[size])


def allocate(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """An uninitialized array for compiled functions, on the CPU whatever torch's default device and dtype are."""
    return torch.empty(shape, dtype=dtype, device=CPU)


_spare: dict[tuple[tuple[int, ...], torch.dtype], list[Tensor]] = {}


def borrow(*shape: int, dtype: torch.dtype) -> Tensor:
    """An uninitialized array for intermediate results, to be returned by `give_back` where nothing reads it any more.

    The next update borrows the same arrays. Large arrays that are allocated anew for every update break up the memory
    of the C library, so that a run grows.
    """
    spare = _spare.get((shape, dtype))
    try:
        return spare.pop() if spare else allocate(*shape, dtype=dtype)
    except IndexError:  # another thread was faster
        return allocate(*shape, dtype=dtype)


def give_back(tensors: Iterable[Tensor | None]) -> None:
    """Keeps borrowed arrays for the next call of `borrow`."""
    for tensor in tensors:
        if tensor is not None:
            spare = _spare.setdefault((tuple(tensor.shape), tensor.dtype), [])
            if len(spare) < MOST_SPARE:
                spare.append(tensor)


def take_kept(ctx: Any) -> dict[str, Any]:
    """The borrowed arrays in `ctx.kept`, for the only backward pass.

    Raises:
        RuntimeError: An earlier backward pass has given them back.
    """
    kept, ctx.kept = ctx.kept, None
    if kept is None:
        raise RuntimeError("the gradients of a compiled call can be computed once only, also with retain_graph=True")
    return kept  # type: ignore[no-any-return]


def require_kernels(tensor: Tensor) -> Kernels:
    """The compiled functions for a tensor's format; a caller has asked `fits` whether there are any."""
    kernels = find_kernels(tensor.dtype)
    assert kernels is not None
    return kernels


def check_shape(name: str, tensor: Tensor | None, *shape: int) -> None:
    """Raises ValueError for a tensor of another shape or device, because compiled functions read at its address."""
    if tensor is None:
        return
    check_place(name, tensor)
    if tensor.shape != shape:
        raise ValueError(f"{name} has the shape {tuple(tensor.shape)}; the model needs {shape}")


def check_place(name: str, tensor: Tensor) -> None:
    """Raises ValueError for a tensor outside of the CPU's memory, where compiled functions cannot read."""
    if not tensor.is_cpu:
        raise ValueError(f"{name} is on device {tensor.device}; the model needs it on the CPU")


def describe_layer(linear: Tensor, scale: Tensor | None, shift: Tensor) -> Layer:
    """The layer with these weights (out, in); every tensor must be contiguous, and must live on."""
    outputs, inputs = linear.shape
    return Layer(linear.data_ptr(), None if scale is None else scale.data_ptr(), shift.data_ptr(), inputs, outputs)


def point_to(structure: ctypes.Structure, **tensors: Tensor | None) -> None:
    """Sets fields of a structure to the places of contiguous tensors; None becomes NULL."""
    for name, tensor in tensors.items():
        assert tensor is None or tensor.is_contiguous(), name
        setattr(structure, name, None if tensor is None else tensor.data_ptr())


def pad_size(size: int) -> int:
    """The size up to which arrays of factors are padded."""
    return -(-size // MULTIPLE) * MULTIPLE


def pad(tensor: Tensor, dim: int, multiple: int = TILE) -> Tensor:
    """The tensor with zeros behind an axis, up to a multiple of a size."""
    missing = -tensor.shape[dim] % multiple
    return functional.pad(tensor, [0, 0] * (tensor.dim() - 1 - dim) + [0, missing]) if missing else tensor


def pad_rows(tensor: Tensor, dim: int) -> Tensor:
    """The tensor with rows of zeros up to a multiple of `TILE` along an axis, contiguous."""
    return pad(tensor, dim).contiguous()


def lay_rows(tensor: Tensor, real: torch.dtype) -> Tensor:
    """A tensor (step, rows, size) in a format, whose rows begin `stride(1)` numbers apart in every step.

    Rows of zeros follow the last, up to a multiple of `TILE`.
    """
    tensor = tensor.to(real)
    if tensor.shape[1] % TILE:
        return pad_rows(tensor, 1)
    is_regular = tensor.stride(2) == 1 and tensor.stride(0) == tensor.shape[1] * tensor.stride(1)
    return tensor if is_regular else tensor.contiguous()


def weight_gradient(of_outputs: Tensor, inputs: Tensor, weight: Tensor) -> Tensor:
    """The gradient of a layer's weight (out, in), from padded factors (..., padded size)."""
    product = of_outputs.flatten(0, -2).t() @ inputs.flatten(0, -2)
    outputs, columns = weight.shape
    return product[:outputs, :columns].to(weight.dtype)


def split_norms(norms: Tensor, sizes: Sequence[int]) -> list[Tensor]:
    """Gradients of scale and shift of some norms, which compiled functions store side by side."""
    return list(norms.split([size for size in sizes for _ in range(2)]))


def check_called(failed: int) -> None:
    """Raises MemoryError if a compiled function could not allocate memory."""
    if failed:
        raise MemoryError("not enough memory for an update of the model")


def fits(module: nn.Module) -> bool:
    """Whether compiled functions can compute a module: float32 or float64 weights of moderate sizes on the CPU."""
    first, *others = module.parameters()
    return (
        all(
            parameter.device.type == "cpu" and parameter.dtype == first.dtype and max(parameter.shape) <= LONGEST_ROW
            for parameter in (first, *others)
        )
        and find_kernels(first.dtype) is not None
    )
