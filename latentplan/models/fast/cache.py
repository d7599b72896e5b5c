"""The user's cache of compiled libraries: a file is loaded only if this user alone could have written it, unchanged.

The name of a cached file can be guessed, and loading a library executes it. The cache therefore lies in a folder that
only the user can enter; a library belongs to the user, cannot be written by others, and has the checksum in the file
beside it. Whatever does not hold is built again.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import hashlib
import os
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from latentplan.config.manifest import sync

SUM = ".sha256"
LOCK = ".lock"
_OTHERS = 0o077
_OTHERS_WRITE = 0o022


def load_cached(name: str, build: Callable[[Path], None]) -> ctypes.CDLL:
    """The library of a name, taken from the cache where the cache can be trusted, else built.

    Where no folder of the cache can be trusted or written, the library is built in a private folder, which is removed
    as soon as the library is loaded.

    Args:
        name: Name of the file; it has to change with the content that `build` makes.
        build: Writes the library to a path.

    Raises:
        OSError: Neither the cache nor the folder for temporary files can be written, or the library cannot be loaded.
        RuntimeError: The user's home directory is unknown.
    """
    folder = _open_folder()
    if folder is None:
        with tempfile.TemporaryDirectory(prefix="latentplan-") as private:
            build(Path(private) / name)
            return ctypes.CDLL(str(Path(private) / name))
    with _locked(folder):
        if is_trusted(folder / name):
            with contextlib.suppress(OSError):  # built for another system, as in a home that machines share
                return ctypes.CDLL(str(folder / name))
        _build_into(folder, name, build)
        return ctypes.CDLL(str(folder / name))


def is_trusted(library: Path) -> bool:
    """Whether a library and its checksum belong to this user, cannot be written by others, and agree."""
    noted = library.with_name(library.name + SUM)
    try:
        return _read_own(noted).decode().strip() == hashlib.sha256(_read_own(library)).hexdigest()
    except (OSError, ValueError):
        return False


def _open_folder() -> Path | None:
    """The folder of the cache, which only this user can enter; None where there cannot be such a folder."""
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache").absolute() / "latentplan"
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileExistsError):
            folder.mkdir(mode=0o700)
        facts = folder.lstat()
        if not stat.S_ISDIR(facts.st_mode) or facts.st_uid != os.geteuid():
            return None
        if facts.st_mode & _OTHERS:
            folder.chmod(0o700)
        return folder if os.access(folder, os.W_OK | os.X_OK) else None
    except OSError:
        return None


def _build_into(folder: Path, name: str, build: Callable[[Path], None]) -> None:
    """Build a library beside its place, then move library and checksum there."""
    for path in (folder / name, folder / (name + SUM)):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
    with tempfile.TemporaryDirectory(dir=folder) as private:
        fresh, noted = Path(private) / name, Path(private) / (name + SUM)
        build(fresh)
        noted.write_text(hashlib.sha256(fresh.read_bytes()).hexdigest() + "\n")
        for path in (fresh, noted):
            path.chmod(0o600)
            sync(path)
            path.replace(folder / path.name)
    sync(folder)


def _read_own(path: Path) -> bytes:
    """The content of a regular file, no link, that belongs to this user and that others cannot write.

    Raises:
        OSError: The file is missing or is none of this.
    """
    opened = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    with os.fdopen(opened, "rb") as file:
        facts = os.fstat(opened)
        if not stat.S_ISREG(facts.st_mode) or facts.st_uid != os.geteuid() or facts.st_mode & _OTHERS_WRITE:
            raise PermissionError(f"{path} is not this user's own")
        return file.read()


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Lets one process at a time check and build; on a file system without locks all may."""
    opened = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    try:
        with contextlib.suppress(OSError):
            fcntl.flock(opened, fcntl.LOCK_EX)
        yield
    finally:
        os.close(opened)
