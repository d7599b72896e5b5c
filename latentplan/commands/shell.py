"""Shared parts of the commands: errors as one line and an exit code, device and threads, settings of a checkpoint."""

from __future__ import annotations

import contextlib
import io
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from latentplan.config import MAX_THREADS, Config, Device, ModelConfig, PlannerConfig, UserError, from_dict, to_dict
from latentplan.config.checks import EnvironmentFault, cut, shown, within
from latentplan.config.env_id import as_file_name
from latentplan.config.estimates import check_parts, estimate_model, estimate_search
from latentplan.config.extras import describe_missing, extra_of
from latentplan.config.files import build_config, has_cuda
from latentplan.config.parsing import option
from latentplan.config.planner import override_planner


def run_guarded(command: Callable[[Sequence[str]], int], argv: Sequence[str]) -> int:
    """The exit code of a command: 2 after a mistake of the user, which becomes one line on stderr.

    A failed environment gives one line and the environment's own traceback. Ctrl-C gives 130, SIGTERM 143 and SIGHUP
    129. A reader that closes the output early, as in `train.py --help | head`, gives 141. Characters that stdout cannot
    encode are printed as escapes, as Python does on stderr. Output to a stream that is closed is lost.
    """
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed before the program began
            setattr(sys, name, open(os.devnull, "w"))
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")  # for names of files that are not UTF-8
    try:
        try:
            with _ending_by_signals():
                return command(argv)
        finally:
            sys.stdout.flush()
    except EnvironmentFault as error:
        return refuse(str(error), error.origin)
    except (UserError, FloatingPointError) as error:
        return refuse(str(error))
    except ModuleNotFoundError as error:
        if extra_of(error.name) is None:
            raise
        return refuse(describe_missing(str(error.name), "this command"))
    except MemoryError:
        return refuse("not enough memory: lower the sizes that were asked for, or end other programs")
    except RuntimeError as error:
        if not _is_out_of_memory(error):
            raise
        return refuse("not enough memory on the device: lower the sizes that were asked for, or end other programs")
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except OSError as error:
        if error.strerror is None:
            raise
        name = "" if error.filename is None else f": {shown(str(error.filename))}"
        return refuse(f"the system refused a file or a process{name}: {error.strerror}")


@dataclass(frozen=True, kw_only=True)
class ComputeRequest:
    """Device and CPU threads of a command.

    Attributes:
        device: Device to compute on; `auto` takes CUDA where it is usable.
        threads: CPU threads, in [1, 1024]; None takes torch's own number, or 1 where more threads gain nothing.
    """

    device: Device = option("auto", is_last=True)
    threads: int | None = option(None, is_last=True)

    def __post_init__(self) -> None:
        if self.threads is not None:
            within(self, threads=(1, MAX_THREADS))

    def use_device(self, threads: int | None = None) -> str:
        """The device, `cpu` or `cuda`; also sets torch's number of CPU threads where one is given.

        Args:
            threads: CPU threads where the user gave no number; None leaves the number to torch.

        Raises:
            UserError: The device cannot be used.
        """
        import torch

        threads = self.threads or threads
        if threads is not None:
            torch.set_num_threads(threads)
        has_cuda = torch.cuda.is_available()
        if self.device == "cuda" and not has_cuda:
            raise UserError("device 'cuda' is not usable here; give --device cpu")
        return ("cuda" if has_cuda else "cpu") if self.device == "auto" else self.device


def saved_config(checkpoint: Path, info: Mapping[str, Any]) -> Config:
    """The settings of a checkpoint.

    Args:
        checkpoint: Folder of the checkpoint, which an error names.
        info: Content of its `info.json`.

    Raises:
        UserError: The settings are those of an incompatible version.
    """
    try:
        return from_dict(info["config"])
    except (AttributeError, TypeError, ValueError) as error:
        raise UserError(f"{checkpoint} has settings of another version: {error}") from None


def search_settings(saved: Config, given: Mapping[str, Any]) -> PlannerConfig:
    """The settings of a checkpoint's search with the given ones in their place.

    Args:
        saved: All settings of the checkpoint.
        given: Settings of the search that were given, by name.

    Raises:
        UserError: A given value is not allowed beside the saved ones, or there is no such planner.
    """
    from latentplan.training.checks import check_planner

    planner = build_config({"planner": override_planner(to_dict(saved.planner), given)}).planner
    check_planner(planner.method)
    return planner


def read_search(checkpoint: Path, given: Mapping[str, Any]) -> PlannerConfig:
    """The settings of the search of a checkpoint on disk with the given ones in their place.

    Args:
        checkpoint: Folder of a trained agent, or of a run.
        given: Settings of the search that were given, by name.

    Raises:
        UserError: The checkpoint cannot be read, or as for `search_settings`.
    """
    from latentplan.agents.info import read_info

    return search_settings(saved_config(checkpoint, read_info(checkpoint)), given)


def check_search(planner: PlannerConfig, model: ModelConfig) -> None:
    """Refuses a search that this machine cannot serve, before torch is imported.

    Args:
        planner: Settings of the search.
        model: Sizes of the model.

    Raises:
        UserError: The search or the model does not fit into the free memory, or a decision would take minutes.
    """
    from latentplan.replay.memory import free_memory

    check_parts([estimate_search(planner, model, has_cuda()), estimate_model(model)], free_memory())


@dataclass(frozen=True, kw_only=True)
class LearningRequest(ComputeRequest):
    """The command line of teaching a trained agent: the agent, the output folder, or a folder to resume.

    Attributes:
        checkpoint: Folder of a trained agent, or of a run (its best checkpoint).
        out: Folder of the agent that has learned; None makes one under `runs`, named by agent, task and date.
        resume: Folder of the learning to continue.
    """

    checkpoint: Path | None = option(None, metavar="DIR")
    out: Path | None = option(None, metavar="DIR")
    resume: Path | None = option(None, metavar="DIR")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.checkpoint is None and self.resume is None:
            raise UserError("flag --checkpoint is missing; give the folder of a trained agent or of a run")
        from latentplan.training.checks import check_launcher

        check_launcher()  # before Lightning is imported


@dataclass(frozen=True, kw_only=True)
class HubRequest:
    """The repository and the address of the model hub.

    Attributes:
        repo: Repository of the model hub, as OWNER/NAME.
        endpoint: Address of the hub; None takes the variable HF_ENDPOINT, or the public hub.
    """

    repo: str = option(metavar="REPO", is_positional=True)
    endpoint: str | None = option(None, metavar="URL", is_last=True)

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[\w.-]{1,96}/[\w.-]{1,96}", self.repo, re.ASCII):
            raise UserError(f"a repository is named OWNER/NAME, got {shown(self.repo)}")
        if self.endpoint is not None and not self.endpoint.startswith(("http://", "https://")):
            raise UserError(f"--endpoint must begin with https:// or http://, got {shown(self.endpoint)}")


def name_folder(kind: str, info: Mapping[str, Any]) -> Path:
    """The default folder of an agent that is taught: `runs/<kind>-<domain>-<task>-<date>`.

    Args:
        kind: First word of the name, such as `distilled`.
        info: Content of the `info.json` of the agent.
    """
    name = as_file_name(f"{kind}-{info['domain']}-{info['task']}")
    return Path("runs") / f"{name}-{datetime.now():%Y%m%d-%H%M%S}"


@contextlib.contextmanager
def _ending_by_signals() -> Iterator[None]:
    """Makes SIGTERM and SIGHUP end a command by an ordinary exit, so that it ends the processes that it has started."""
    numbers = (signal.SIGTERM, signal.SIGHUP) if threading.current_thread() is threading.main_thread() else ()
    previous = {number: signal.getsignal(number) for number in numbers}
    for number, handler in previous.items():
        if handler == signal.SIG_DFL:
            signal.signal(number, lambda received, _: sys.exit(128 + received))
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _is_out_of_memory(error: RuntimeError) -> bool:
    """Whether torch could not allocate memory; on a CPU its error has no class of its own."""
    text = str(error)
    return "can't allocate memory" in text or "out of memory" in text or "Storage size calculation overflowed" in text


def refuse(message: str, details: str = "") -> int:
    """Prints an error as one line on stderr, and returns the exit code 2.

    Args:
        message: The error.
        details: Further lines, such as a traceback, each with its end.
    """
    line = cut(" ".join(message.split())).encode(sys.stderr.encoding or "utf-8", "backslashreplace")
    with contextlib.suppress(OSError):  # where nothing can be printed, the exit code still tells
        print(f"error: {line.decode(sys.stderr.encoding or 'utf-8')}\n{details}", file=sys.stderr, end="", flush=True)
    return 2
