"""Compiled C code: kernels for the elementwise parts of a rollout, one pass over each row instead of many.

The machine's C compiler builds the sources beside this file at the first use, in about a second, and the user's cache
keeps the library. Torch computes the same if there is no compiler, if a tensor is not on the CPU, if gradients are
required, and if `LATENTPLAN_KERNELS=0`.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import logging
import multiprocessing
import os
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch
from torch import Tensor

from latentplan.config.checks import cut
from latentplan.models.fast import pointwise
from latentplan.models.fast.cache import load_cached

FOLDER = Path(__file__).parent
HEADERS = ("rows.h", "vectors.h", "products.h", "wide.h", "layers.h", "convolutions.h")
LEARNED = ("unroll.c", "heads.c", "encoder.c", "decoder.c")  # with gradients
PLANNED = ("kernels.c", "imagine.c", "frame.c")
# Sums may be reordered, because compilers cannot vectorize them otherwise; all other rules of IEEE 754 hold.
ARITHMETIC = ("-fassociative-math", "-fno-signed-zeros", "-fno-trapping-math", "-fno-math-errno")
FLAGS = ("-O3", "-march=native", *ARITHMETIC, "-fopenmp", "-shared", "-fPIC")
WIDE = "-mprefer-vector-width=512"  # only x86 compilers accept it
LONGEST_ROW = 4096  # as in kernels.c
COMPILE_SECONDS = 300  # of a busy machine; an idle one takes three
BFLOAT16_FEATURES = {"avx512_bf16", "amx_bf16"}  # as Linux names them
DTYPES = {torch.bfloat16: "bfloat16", torch.float32: "float32"}

LOGGER = logging.getLogger("latentplan")

Norm = tuple[Tensor, Tensor]  # scale and shift


def norm_silu(product: Tensor, norm: Norm) -> Tensor:
    """The SiLU of the layer norm of rows (..., size), in the product's dtype; in place if no gradient is required."""
    scale, shift = norm
    library = _library_for(product, scale, shift)
    if library is None:
        return pointwise.norm_silu(product, scale, shift)
    rows, size = product.numel() // product.shape[-1], product.shape[-1]
    kernel = getattr(library, f"norm_silu_{DTYPES[product.dtype]}")
    kernel(*_pointers(product, scale, shift), rows, size, torch.get_num_threads())
    return product


def gates(product: Tensor, norm: Norm, deter: Tensor) -> tuple[Tensor, Tensor]:
    """The next deterministic state of the GRU, from the gates before their norm; see `next_deter`.

    Args:
        product: Reset, candidate and update gate before their norm, side by side, (rows, 3 deter).
        norm: Scale and shift of the gates' layer norm.
        deter: The previous state, float32 (rows, deter).

    Returns:
        The state, float32 (rows, deter), and its copy in the product's dtype.
    """
    scale, shift = norm
    library = _library_for(product, scale, shift, deter)
    if library is None:
        following = pointwise.update_deter(product.to(scale.dtype), scale, shift, deter)
        return following, following.to(product.dtype)
    deter = deter.contiguous()
    following, rounded = torch.empty_like(deter), torch.empty_like(deter, dtype=product.dtype)
    kernel = getattr(library, f"gates_{DTYPES[product.dtype]}")
    kernel(*_pointers(product, scale, shift, deter, following, rounded), *deter.shape, torch.get_num_threads())
    return following, rounded


def expectation(logits: Tensor, values: Tensor) -> Tensor:
    """The mean (rows,) of values (bin,) under the softmax of float32 logits (rows, bin)."""
    library = _library_for(logits, values) if logits.dtype == torch.float32 else None
    if library is None:
        return logits.softmax(-1) @ values
    means = logits.new_empty(len(logits))
    library.expectation(*_pointers(logits, values, means), *logits.shape, torch.get_num_threads())
    return means


def _library_for(rows: Tensor, *others: Tensor) -> ctypes.CDLL | None:
    """The compiled kernels; None if they cannot compute with these tensors."""
    tensors = (rows, *others)
    if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors):
        return None
    known = rows.is_cpu and rows.dtype in DTYPES and rows.is_contiguous()
    fit = rows.shape[-1] <= LONGEST_ROW and all(each.is_cpu and each.dtype == torch.float32 for each in others)
    return load() if known and fit else None


def _pointers(*tensors: Tensor) -> list[int]:
    return [tensor.data_ptr() for tensor in tensors]


@functools.cache
def load(*, is_exact: bool = False) -> ctypes.CDLL | None:
    """The compiled library; None if it is switched off or cannot be built.

    Args:
        is_exact: Whether the functions with gradients compute in float64, without rounding; then the library holds
            these functions alone.
    """
    if os.environ.get("LATENTPLAN_KERNELS") == "0":
        return None
    try:
        library = _compile(LEARNED, ["-DEXACT"]) if is_exact else _compile(PLANNED + LEARNED, [])
    except (OSError, RuntimeError, subprocess.SubprocessError) as error:
        _say_slower("the C compiler failed" if isinstance(error, subprocess.SubprocessError) else cut(str(error)))
        return None
    place, count, threads, number = ctypes.c_void_p, ctypes.c_long, ctypes.c_int, ctypes.c_double
    library.unroll.argtypes = library.apply_network.argtypes = [place, threads]
    library.unroll_back.argtypes = library.apply_network_back.argtypes = [place, place, threads]
    library.encode.argtypes = library.decode.argtypes = [place, place, threads]
    library.mean_of_bins.argtypes = [place] * 4 + [count, count]
    library.cross_entropy.argtypes = [place] * 5 + [count, count]
    library.lambda_return.argtypes = [place] * 3 + [number, place, count, count]
    library.lambda_return_back.argtypes = [place] * 3 + [number] + [place] * 4 + [count, count]
    if is_exact:
        return library
    for dtype in DTYPES.values():
        getattr(library, f"norm_silu_{dtype}").argtypes = [place] * 3 + [count, count, threads]
        getattr(library, f"gates_{dtype}").argtypes = [place] * 6 + [count, count, threads]
    library.expectation.argtypes = [place] * 3 + [count, count, threads]
    library.imagine.argtypes = [place] * 6 + [count, count, threads]
    library.decide.argtypes = [place, place, count, threads]
    return library


@functools.cache
def _say_slower(reason: str) -> None:
    """Says in one line, once, that torch computes instead; processes that the program starts stay silent."""
    if multiprocessing.parent_process() is None:
        LOGGER.warning("latentplan: no compiled kernels (%s); torch computes instead, slower", reason)


def _compile(names: Sequence[str], options: Sequence[str]) -> ctypes.CDLL:
    """The library compiled from some sources, which is built if the cache does not hold it; see `load_cached`.

    Raises:
        OSError: There is no compiler, or nothing can be written.
        RuntimeError: The user's home directory is unknown.
        subprocess.SubprocessError: The compiler failed.
    """
    compiler = os.environ.get("CC") or next(filter(shutil.which, ("cc", "gcc", "clang")), None)
    if compiler is None:
        raise FileNotFoundError("no C compiler")
    wide = [WIDE] if platform.machine() in ("x86_64", "AMD64") else []
    sources = [FOLDER / name for name in names]
    command = [*compiler.split(), *FLAGS, *wide, *options]
    texts = [source.read_text() for source in (*(FOLDER / name for name in HEADERS), *sources)]
    key = hashlib.sha256("\n".join([*command, _describe_processor(), *texts]).encode()).hexdigest()[:16]

    def run(*arguments: str | Path) -> None:
        subprocess.run([*command, *map(str, arguments)], check=True, capture_output=True, timeout=COMPILE_SECONDS)

    def build(path: Path) -> None:
        with tempfile.TemporaryDirectory(dir=path.parent) as folder, ThreadPoolExecutor() as threads:
            objects = [Path(folder) / f"{source.stem}.o" for source in sources]
            list(threads.map(lambda source, to: run("-c", source, "-o", to), sources, objects))
            run(*objects, "-o", path, "-lm")

    return load_cached(f"kernels-{key}.so", build)


@functools.cache
def find_fast_dtype() -> torch.dtype:
    """The precision in which this processor multiplies matrices fastest.

    Torch emulates bfloat16 on a processor without instructions for it, fifty times as slow as float32.
    """
    return torch.bfloat16 if BFLOAT16_FEATURES & set(_describe_processor().split()) else torch.float32


@functools.cache
def _describe_processor() -> str:
    """The features of this processor, on which compiled code depends."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line for line in lines if line.startswith(("flags", "Features"))), "")
