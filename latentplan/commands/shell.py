"""Running a command: errors as one line and an exit code, and the choice of device and threads."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from latentplan.config import MAX_THREADS, Device, UserError
from latentplan.config.checks import within
from latentplan.config.parsing import option


def run_guarded(command: Callable[[Sequence[str]], int], argv: Sequence[str]) -> int:
    """The exit code of a command: 2 after a mistake of the user, which becomes one line on stderr.

    An interrupt gives 130. A reader that closes the output early, as in `train.py --help | head`, gives 141.
    """
    try:
        try:
            return command(argv)
        finally:
            sys.stdout.flush()
    except (UserError, FloatingPointError) as error:
        return _refuse(str(error))
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except OSError as error:
        if error.errno != errno.ENAMETOOLONG:
            raise
        return _refuse(f"a file name is too long: {str(error.filename)[:80]}...")


def _refuse(message: str) -> int:
    line = " ".join(message.split()).encode(sys.stderr.encoding or "utf-8", "backslashreplace")
    print(f"error: {line.decode(sys.stderr.encoding or 'utf-8')}", file=sys.stderr)
    return 2


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
