"""Resources of a run: device and threads, and the trainer that uses them."""

from __future__ import annotations

import contextlib
import logging
import warnings
from collections.abc import Iterator
from typing import TYPE_CHECKING

import torch

from latentplan.config import RunConfig, UserError
from latentplan.config.estimates import count_cores

if TYPE_CHECKING:
    import lightning

COLLECTOR_THREADS = 4  # an upper limit, because runs often share a machine


def choose_device(run: RunConfig, number: int = 0) -> torch.device:
    """The device on which a run learns; "auto" takes CUDA if there is one.

    Where several processes learn on one machine, each asks for a GPU by its `number`.

    Raises:
        UserError: The settings ask for CUDA, but torch finds no CUDA device.
    """
    if run.device == "cuda" and not torch.cuda.is_available():
        raise UserError("device cuda was asked for, but torch finds no CUDA device: use --device cpu")
    is_cuda = run.device == "cuda" or (run.device == "auto" and torch.cuda.is_available())
    if not is_cuda:
        return torch.device("cpu")
    return torch.device("cuda", number) if run.devices > 1 else torch.device("cuda")


def choose_collector_threads(device: torch.device, collectors: int = 1) -> int:
    """CPU threads of each collection process: one if the learner uses the CPU, up to 4 if the learner uses a GPU."""
    return 1 if device.type == "cpu" else min(max(1, count_cores() // (4 * collectors)), COLLECTOR_THREADS)


@contextlib.contextmanager
def keep_threads() -> Iterator[None]:
    """Gives torch its number of CPU threads back when the context ends."""
    before = torch.get_num_threads()
    try:
        yield
    finally:
        torch.set_num_threads(before)


def set_up_torch(threads: int, device: torch.device) -> None:
    """Sets torch's number of CPU threads and, on a GPU, lets matrix products use tensor cores."""
    torch.set_num_threads(threads)
    if device.type == "cuda":
        torch.set_float32_matmul_precision("high")  # TF32, which has three more bits than bfloat16


def make_trainer(device: torch.device, callbacks: list[lightning.Callback]) -> lightning.Trainer:
    """Lightning's trainer of this process on one device; of several processes that learn together, each has its own."""
    import lightning  # takes seconds, and collection processes do without

    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", module="lightning")
    return lightning.Trainer(
        accelerator="gpu" if device.type == "cuda" else "cpu",
        devices=[device.index or 0] if device.type == "cuda" else 1,
        max_epochs=-1,
        callbacks=callbacks,
        logger=False,  # a callback writes the trackers
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        log_every_n_steps=10**9,
    )
