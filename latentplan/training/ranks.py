"""Ranks: the processes that learn together, each with a share of every batch, a replay and a collector of its own.

Lightning starts the processes and sets up their process group (`Fabric` with its strategy `ddp`), or joins those that
torchrun or a cluster has started. The wrapper `DistributedDataParallel` does not fit the learner: its hooks expect one
backward pass over all parameters, and the two halves of an update run side by side and step by hand. The learner
therefore averages one flat vector of gradients and losses for each half.
"""

from __future__ import annotations

import logging
import os
import pickle
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import timedelta
from typing import Any, TypeVar

import torch
from torch import Tensor

from latentplan.config import Config, UserError, derive_seed
from latentplan.training.checks import is_started_outside, read_number
from latentplan.training.collection.episodes import Stopped
from latentplan.training.resources import choose_device

MODEL, BEHAVIOUR = 0, 1  # the two halves of an update
LONGEST_WAIT = timedelta(days=1)  # for a rank that evaluates, or collects a long round

Value = TypeVar("Value")


class RankEnded(UserError):
    """Another process of the run has ended, so that this process cannot go on."""


class Ranks:
    """A process that learns alone; `JoinedRanks` stands for one of several.

    Attributes:
        rank: Number of this process, from 0; rank 0 evaluates, prints, and writes the folder of the run.
        size: Number of processes.
        device: Number of the GPU of this process on its machine.
        in_turn: Whether the two halves of an update must run one after the other.
    """

    rank: int = 0
    size: int = 1
    device: int = 0
    in_turn: bool = False

    @property
    def is_first(self) -> bool:
        """Whether this is rank 0."""
        return self.rank == 0

    def part(self, joint: Tensor, dim: int = 0) -> Tensor:
        """The part of this rank of a tensor about the whole batch, which every rank has computed alike."""
        return joint

    def gather(self, own: Tensor, half: int, dim: int = 0) -> Tensor:
        """The tensors of all ranks in one, in the order of their ranks; the inverse of `part`.

        Args:
            own: A tensor of the same shape on every rank, without gradient.
            half: Which half of an update asks; the halves ask independently of each other.
            dim: Dimension along which the tensors are joined.
        """
        return own

    def mean(self, own: Tensor, half: int) -> Tensor:
        """The mean of a tensor over all ranks, without gradient."""
        return own

    def average(self, tensors: Sequence[Tensor], half: int) -> None:
        """Replace tensors by their means over all ranks, in one message."""

    def together(self, function: Callable[[], Value]) -> list[Value]:
        """The results of a function on all ranks, by rank; an error on one rank is raised on all."""
        return [function()]

    def lead(self, function: Callable[[], Value]) -> Value:
        """The result of a function that rank 0 alone calls; its error is raised on all ranks."""
        return function()

    def largest(self, number: int) -> int:
        """The largest number of all ranks."""
        return number

    def close(self) -> None:
        """Close the connections to the other ranks."""

    def own_config(self, config: Config) -> Config:
        """The settings of this rank's collection: rank r > 0 has random streams and kept episodes of its own."""
        return config


class JoinedRanks(Ranks):
    """One of several processes that learn together.

    Tensors of a half of an update travel through a process group of that half, since both halves run at the same time;
    small values travel through a third group, on the CPU. On GPUs all tensors travel through one group and the halves
    run in turn, because NCCL wants every rank to make its calls in one order.

    Args:
        rank: Number of this process.
        size: Number of processes.
        device: Device of this process; the default process group exists.
    """

    def __init__(self, rank: int, size: int, device: torch.device) -> None:
        self.rank, self.size, self.device = rank, size, device.index or 0
        self.in_turn = device.type == "cuda"
        self._world = torch.distributed.new_group(backend="gloo", timeout=LONGEST_WAIT)
        groups = [torch.distributed.new_group(timeout=LONGEST_WAIT) for _ in range(1 if self.in_turn else 2)]
        self._halves = groups * 2 if self.in_turn else groups

    def part(self, joint: Tensor, dim: int = 0) -> Tensor:
        """The part of this rank."""
        return joint.chunk(self.size, dim)[self.rank]

    def gather(self, own: Tensor, half: int, dim: int = 0) -> Tensor:
        """The tensors of all ranks in one."""
        own = own.contiguous()
        parts = [torch.empty_like(own) for _ in range(self.size)]
        self._call(torch.distributed.all_gather, parts, own, group=self._halves[half])
        return torch.cat(parts, dim)

    def mean(self, own: Tensor, half: int) -> Tensor:
        """The mean over all ranks."""
        total = own.detach().clone()
        self._call(torch.distributed.all_reduce, total, group=self._halves[half])
        return total / self.size

    @torch.no_grad()
    def average(self, tensors: Sequence[Tensor], half: int) -> None:
        """Replace tensors by their means over all ranks."""
        means = self.mean(torch.cat([tensor.flatten() for tensor in tensors]), half)
        parts = means.split([tensor.numel() for tensor in tensors])
        for tensor, part in zip(tensors, parts, strict=True):
            tensor.copy_(part.view_as(tensor))

    def together(self, function: Callable[[], Value]) -> list[Value]:
        """The results of all ranks."""
        own = _outcome(function)
        outcomes = self._exchange(own)
        failed = [rank for rank, (_, error) in enumerate(outcomes) if error is not None]
        if failed:  # a stop before an error, because a signal to all processes also ends their environments
            first = min(failed, key=lambda rank: not isinstance(outcomes[rank][1], Stopped))
            error: Exception = (own if first == self.rank else outcomes[first])[1]
            raise error
        return [value for value, _ in outcomes]

    def lead(self, function: Callable[[], Value]) -> Value:
        """The result of rank 0."""
        own = _outcome(function) if self.is_first else (None, None)
        first = self._exchange(own)[0]
        value, error = own if self.is_first else first
        if error is not None:
            raise error
        return value  # type: ignore[return-value]

    def largest(self, number: int) -> int:
        """The largest number of all ranks."""
        found = torch.tensor(int(number))
        self._call(torch.distributed.all_reduce, found, torch.distributed.ReduceOp.MAX, group=self._world)
        return int(found)

    def close(self) -> None:
        """Close the connections; left open, they may end a process with SIGABRT at its exit."""
        torch.distributed.destroy_process_group()

    def own_config(self, config: Config) -> Config:
        """The settings of this rank's collection."""
        if self.is_first:
            return config
        run = replace(config.run, seed=derive_seed(config.run.seed, "rank", self.rank))
        folder = config.collection.keep_episodes
        if folder is not None:
            folder = os.path.join(folder, f"rank-{self.rank}")
        return replace(config, run=run, collection=replace(config.collection, keep_episodes=folder))

    def _exchange(self, value: Any) -> list[Any]:
        found: list[Any] = [None] * self.size
        self._call(torch.distributed.all_gather_object, found, value, group=self._world)
        return found

    def _call(self, collective: Callable[..., Any], *arguments: Any, **more: Any) -> None:
        try:
            collective(*arguments, **more)
        except RuntimeError as error:
            reason = (str(error).splitlines() or ["no reason given"])[0][:160]
            raise RankEnded(
                f"another process of this run has ended: --resume continues from the last save ({reason})"
            ) from None


ALONE = Ranks()


def place_ranks(config: Config) -> Config:
    """The settings with the numbers of processes and machines that torchrun has started, where it has.

    Raises:
        UserError: The settings name other numbers, or the processes cannot share the settings.
    """
    if not is_started_outside():
        return config
    size, run = read_number("WORLD_SIZE"), config.run
    devices = read_number("LOCAL_WORLD_SIZE", os.environ["WORLD_SIZE"])
    if size % devices:
        raise UserError(f"WORLD_SIZE ({size}) must be a multiple of LOCAL_WORLD_SIZE ({devices})")
    return replace(config, run=replace(run, devices=devices, nodes=size // devices))


def join_ranks(config: Config) -> Ranks:
    """Starts the other processes of a run on this machine where needed, and waits until all processes are there.

    Lightning starts them by the command line of this program, so that each of them arrives here too.

    Args:
        config: Settings, with the numbers of `place_ranks`.

    Raises:
        UserError: The machine has fewer GPUs, or the processes do not find each other.
    """
    run = config.run
    if run.num_ranks == 1:
        return ALONE
    device = choose_device(run)
    if device.type == "cuda" and (found := torch.cuda.device_count()) < run.devices:
        raise UserError(f"run.devices ({run.devices}) must not exceed the GPUs of this machine, {found}")
    is_outside = is_started_outside()
    from lightning.fabric import Fabric
    from lightning.fabric.plugins.environments import TorchElasticEnvironment
    from lightning.fabric.strategies import DDPStrategy

    for name in ("lightning.fabric", "lightning.pytorch"):
        logging.getLogger(name).setLevel(logging.ERROR)
    if is_outside:
        os.environ.setdefault("LOCAL_RANK", str(read_number("RANK") % run.devices))
    fabric = Fabric(
        accelerator="gpu" if device.type == "cuda" else "cpu",
        devices=run.devices,
        num_nodes=run.nodes,
        strategy=DDPStrategy(process_group_backend="nccl" if device.type == "cuda" else "gloo"),
        plugins=[TorchElasticEnvironment()] if is_outside else None,
    )
    try:
        fabric.launch()
    except (RuntimeError, ValueError) as error:  # torch's errors of the network are of these types
        raise UserError(f"the processes of this run did not find each other: {str(error).splitlines()[0]}") from None
    return JoinedRanks(fabric.global_rank, fabric.world_size, fabric.device)


def _outcome(function: Callable[[], Any]) -> tuple[Any, Any]:
    """The result of a function or its error, which other processes can read."""
    try:
        return function(), None
    except Exception as error:
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:
            return None, RuntimeError(f"{type(error).__name__}: {error}")
        return None, error
