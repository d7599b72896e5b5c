"""The Python environment of the peers: the project's packages, and packages that only the peers need."""

from __future__ import annotations

import shlex
import subprocess
import sys
import sysconfig
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from latentplan.config.parsing import raise_unknown

INSTALL_SECONDS = 600
FOLDER = Path(__file__).resolve().parents[3] / "runs" / ".peers" / f"python{sysconfig.get_python_version()}"


class Peer(NamedTuple):
    """A library from PyPI.

    Attributes:
        module: The adapter module of the library.
        package: Name of the library on PyPI.
        requirements: Further packages that pip installs without their dependencies, which come from the project's
            environment.
        controllers: The module with the library's planners in closed loop.
        minimum: Oldest version that the modules can use; empty for any.
    """

    module: str
    package: str
    requirements: tuple[str, ...]
    controllers: str = ""
    minimum: str = ""

    @property
    def all_requirements(self) -> tuple[str, ...]:
        """What pip installs: the library, in a version that the modules can use, and the further packages."""
        return (self.package + (f">={self.minimum}" if self.minimum else ""), *self.requirements)


class PeerError(Exception):
    """A peer cannot take part; the message gives the reason in one line."""


_UTILITIES = ("arm-pytorch-utilities", "pytorch-seed", "scipy", "matplotlib")
PEERS = {
    "torchrl": Peer(
        "bench.peers.torchrl_cem",
        "torchrl",
        ("tensordict<0.15", "pyvers<0.3", "hoptorch", "cloudpickle", "importlib-metadata", "orjson"),
        "bench.controllers.torch_rl",
    ),
    "mbrl": Peer(
        "bench.peers.mbrl_cem",
        "mbrl",
        ("hydra-core", "omegaconf", "antlr4-python3-runtime==4.9.*", "termcolor", "imageio"),
        "bench.controllers.mbrl_lib",
    ),
    "pytorch_mppi": Peer("bench.peers.mppi", "pytorch-mppi", _UTILITIES, "bench.controllers.mppi", "0.9.1"),
    "stable_worldmodel": Peer("bench.peers.stable_cem", "stable-worldmodel", ("loguru",), "bench.controllers.stable"),
    "pytorch_icem": Peer("bench.peers.icem", "pytorch-icem", ("colorednoise", *_UTILITIES), "bench.controllers.icem"),
}


def choose_peers(names: tuple[str, ...]) -> tuple[str, ...]:
    """The peers that a flag names; `none` alone stands for no peer.

    Raises:
        UserError: There is no such peer.
    """
    chosen = () if names == ("none",) else names
    for name in chosen:
        if name not in PEERS:
            raise_unknown("peer", name, [*PEERS, "none"])
    return chosen


@contextmanager
def left_out_on_error(name: str, left_out: dict[str, str]) -> Iterator[None]:
    """Records and prints the reason if a library or planner cannot take part; the caller goes on without it."""
    try:
        yield
    except PeerError as error:
        left_out[name] = str(error)
        print(f"{name} left out: {error}", flush=True)


def install(name: str, folder: Path) -> Path:
    """Installs a peer, and returns the path of the Python of the peers' environment, which is made on first use.

    Args:
        name: One of `PEERS`.
        folder: Folder of the environment.

    Raises:
        PeerError: The peer could not be installed; the message says how to install it.
    """
    requirements, python = PEERS[name].all_requirements, folder / "bin" / "python"
    receipt, wanted = folder / f"{name}.installed", "\n".join(requirements)
    if receipt.is_file() and receipt.read_text() == wanted:
        return python
    command = [str(python), "-m", "pip", "install", "--no-deps", *requirements]
    try:
        if not python.is_file():
            print(f"making an environment for other planners in {folder}", flush=True)
            _call([sys.executable, "-m", "venv", str(folder)])
            _show_own_packages(folder)
        print(f"installing {name} there: {' '.join(requirements)}", flush=True)
        _call([*command, "--quiet", "--disable-pip-version-check"])
    except PeerError as error:
        raise PeerError(f"{error}; to install it: {shlex.join(command)}") from None
    receipt.write_text(wanted)
    return python


def installed_version(name: str, folder: Path) -> str:
    """The version of a peer in the environment that `install` made."""
    found = metadata.distributions(name=PEERS[name].package, path=[str(_site_packages(folder))])
    return next((distribution.version for distribution in found), "unknown")


def last_line(text: str) -> str:
    """The last line of a program's output with the word error, else the last line."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    errors = [line for line in lines if "error" in line.lower()]
    return (errors or lines or [""])[-1]


def _show_own_packages(folder: Path) -> None:
    """Lets the environment in a folder import the project's packages, after its own packages."""
    own = {sysconfig.get_path(kind) for kind in ("purelib", "platlib")}
    (_site_packages(folder) / "own-packages.pth").write_text("\n".join(sorted(own)) + "\n")


def _site_packages(folder: Path) -> Path:
    return Path(sysconfig.get_path("purelib", "venv", {"base": str(folder)}))


def _call(command: Sequence[str]) -> None:
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=INSTALL_SECONDS)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise PeerError(str(error)) from None
    if done.returncode != 0:
        raise PeerError(last_line(done.stderr or done.stdout) or f"exit code {done.returncode}")
