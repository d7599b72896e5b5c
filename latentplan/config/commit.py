"""Commits: saves of which each is there as a whole or not at all, and of which any damage is noticed.

A save is a folder `save-000012` with a manifest: the sizes and SHA-256 checksums of its files, of the committed parts
of append-only logs, and of the manifest itself. `Saves.commit` writes a save in this order: logs are appended and
flushed to the disk, the other files are written beside under the name `save-000012.part` and flushed, the manifest is
written last, the folder is renamed, and its parent is flushed. Only after the new save was read again are older saves
removed, except the one before, to which `Saves.newest` falls back if the new one is damaged.

Logs are appended in place: a save names how many bytes of each log belong to it, so that later bytes do not harm it.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from latentplan.config.checks import UserError, make_folder

MANIFEST = "manifest.json"
LOGS = "logs"  # folder of the logs, beside the saves
PART = ".part"
LARGEST_MANIFEST = 64 * 2**20
_NAME = re.compile(r"save-(\d{6,})")
_FILE = re.compile(r"(?:logs/)?\w[\w.-]*")
_KEYS = {"kind", "format", "note", "files", "logs", "sha256"}
_BLOCK = 2**20


class DamageError(UserError):
    """Saved files differ from what their manifest says; the message is one line."""


@dataclass(frozen=True)
class Extent:
    """The first bytes of a file that belong to a save.

    Attributes:
        bytes: Number of bytes.
        sha256: Checksum of these bytes, in hexadecimal digits.
    """

    bytes: int
    sha256: str


@dataclass(frozen=True)
class Save:
    """A save whose files were compared with its manifest.

    Attributes:
        folder: Folder of its files.
        note: What the manifest says of the save's content, for messages.
        logs: Committed part of each log, by path relative to the folder of all saves.
    """

    folder: Path
    note: Mapping[str, Any]
    logs: Mapping[str, Extent]


class Saves:
    """The saves of one run, in one folder.

    Args:
        folder: Folder of all saves; made at the first commit.
        kind: What is saved, such as `run`; a save of another kind is refused.
        version: Number of the format of the saves; a save of another format is refused.
    """

    def __init__(self, folder: Path, kind: str, version: int) -> None:
        self.folder, self.kind, self.version = folder, kind, version
        self._last: Save | None = None

    def exist(self) -> bool:
        """Whether the folder holds a save, damaged or not."""
        return bool(self._numbers())

    def kinds(self) -> set[str]:
        """What the saves in the folder say that they are, whatever their state."""
        kinds = set()
        for number in self._numbers():
            with contextlib.suppress(OSError, ValueError, TypeError, KeyError):
                kinds.add(str(json.loads((self.folder / f"save-{number:06d}" / MANIFEST).read_text())["kind"]))
        return kinds

    def commit(self, write: Callable[[Path], Mapping[str, Extent]], note: Mapping[str, Any]) -> Save:
        """Adds a save.

        Args:
            write: Writes the files of the save into a folder, appends to logs, and returns the committed part of each
                log by its path relative to the folder of all saves.
            note: Says in a few plain values what is saved.

        Raises:
            OSError: The save cannot be written; the saves before it stay, and nothing is left of the new one.
            DamageError: The new save differs from what was written when it is read again.
        """
        make_folder(self.folder)
        final = self.folder / f"save-{max(self._numbers(), default=0) + 1:06d}"
        part = final.with_name(final.name + PART)
        try:
            shutil.rmtree(part, ignore_errors=True)
            part.mkdir()
            logs = write(part)
            write_manifest(part, self.kind, self.version, note, logs)
            sync(part)
            part.rename(final)
        except BaseException:
            shutil.rmtree(part, ignore_errors=True)
            raise
        sync(self.folder)
        saved = self.verify(final, check_logs=False)
        previous, self._last = self._last, saved
        self._prune(saved, previous)
        return saved

    def newest(self) -> tuple[Save, list[str]]:
        """The newest save that is whole, and one line for each newer save that is not.

        Raises:
            UserError: There is no save, or none is whole, or the newest has another format.
        """
        problems: list[str] = []
        for number in sorted(self._numbers(), reverse=True):
            try:
                self._last = self.verify(self.folder / f"save-{number:06d}")
                return self._last, problems
            except DamageError as error:
                problems.append(str(error))
        if problems:
            raise DamageError(f"no save in {self.folder} is whole: {problems[0]}")
        raise UserError(f"nothing to resume in {self.folder.parent}: {self.folder} holds no save")

    def find(self, name: str) -> Path | None:
        """A file in the newest save in which this file is whole; None where there is none."""
        for number in sorted(self._numbers(), reverse=True):
            folder = self.folder / f"save-{number:06d}"
            with contextlib.suppress(DamageError):
                extent = read_manifest(folder, self.kind, self.version).files.get(name)
                if extent is not None:
                    check_extent(folder / name, extent, is_whole=True)
                    return folder / name
        return None

    def remove_leftovers(self) -> None:
        """Remove what interrupted commits left beside the saves."""
        for path in self.folder.glob(f"*{PART}"):
            shutil.rmtree(path, ignore_errors=True)

    def verify(self, folder: Path, *, check_logs: bool = True) -> Save:
        """Compares the files of a save with its manifest.

        Args:
            folder: Folder of the save.
            check_logs: Whether the committed parts of logs are compared too.

        Raises:
            DamageError: A file is missing or differs.
            UserError: The save has another format.
        """
        manifest = read_manifest(folder, self.kind, self.version)
        check_files(folder, manifest)
        for name, extent in manifest.logs.items():
            if check_logs:
                check_extent(self.folder / name, extent, is_whole=False)
        return Save(folder, manifest.note, manifest.logs)

    def _numbers(self) -> list[int]:
        names = [path.name for path in self.folder.iterdir()] if self.folder.is_dir() else []
        return [int(match[1]) for name in names if (match := _NAME.fullmatch(name))]

    def _prune(self, new: Save, previous: Save | None) -> None:
        """Remove all saves but two, and logs that neither of these two names."""
        kept = [save for save in (new, previous) if save is not None]
        folders, logs = {save.folder.name for save in kept}, {name for save in kept for name in save.logs}
        for number in self._numbers():
            if (name := f"save-{number:06d}") not in folders:
                shutil.rmtree(self.folder / name, ignore_errors=True)
        for path in (self.folder / LOGS).glob("*"):
            if f"{LOGS}/{path.name}" not in logs:
                path.unlink(missing_ok=True)


class Log:
    """Rows of equal size, numbered from 0 and appended to files of at most `rows_per_file` rows.

    The files are named by their first row. Rows that were appended stay as they are; whole files of rows that are no
    longer needed leave the log.

    Args:
        folder: Folder of all saves.
        name: Begins the names of the files.
        row_bytes: Size of a row.
        rows_per_file: Rows in a file.
    """

    def __init__(self, folder: Path, name: str, row_bytes: int, rows_per_file: int = 1024) -> None:
        self.folder, self.name, self.row_bytes, self.rows_per_file = folder, name, row_bytes, rows_per_file
        self._extents: dict[int, Extent] = {}  # by the first row of the file
        self._hasher: Any = None  # of the last file, as far as it is committed

    @property
    def end(self) -> int:
        """Number of the row that follows the last one; 0 in an empty log."""
        if not self._extents:
            return 0
        first = max(self._extents)
        return first + self._extents[first].bytes // self.row_bytes

    def path(self, first: int) -> Path:
        """The file that begins with a row."""
        return self.folder / LOGS / f"{self.name}-{first:012d}"

    def append(self, first: int, blocks: Iterator[bytes]) -> None:
        """Append consecutive rows and flush them to the disk.

        Args:
            first: Number of the first row, at least `end`. A gap begins a new file.
            blocks: Whole rows, one after another.

        Raises:
            OSError: The rows cannot be written; the log stays as it was.
        """
        make_folder(self.folder / LOGS)
        before = dict(self._extents)
        try:
            row = first
            for block in blocks:
                rest = memoryview(block)
                while rest:
                    start = max(self._extents, default=0)
                    if not self._extents or row != self.end or row - start >= self.rows_per_file:
                        start, self._extents[row] = row, Extent(0, "")
                        self._hasher = hashlib.sha256()
                    count = min(len(rest) // self.row_bytes, start + self.rows_per_file - row)
                    self._append_to(start, rest[: count * self.row_bytes])
                    rest, row = rest[count * self.row_bytes :], row + count
            sync(self.folder / LOGS)
        except BaseException:
            touched = list(self._extents)
            self._extents, self._hasher = before, None
            for first in touched:  # a full disk needs the room; other files may belong to the save before
                with contextlib.suppress(OSError):
                    os.truncate(self.path(first), before[first].bytes if first in before else 0)
            raise

    def drop_before(self, row: int) -> None:
        """Forget files whose rows all come before a row."""
        for first in sorted(self._extents)[:-1]:
            if first + self._extents[first].bytes // self.row_bytes <= row:
                del self._extents[first]

    def extents(self) -> dict[str, Extent]:
        """The committed part of each file, by path relative to the folder of all saves."""
        return {str(self.path(first).relative_to(self.folder)): part for first, part in self._extents.items()}

    def restore(self, logs: Mapping[str, Extent]) -> None:
        """Continue after the rows that a save committed; later rows are overwritten."""
        prefix = f"{LOGS}/{self.name}-"
        self._extents = {
            int(name.removeprefix(prefix)): extent for name, extent in logs.items() if name.startswith(prefix)
        }
        self._hasher = None

    def rows(self) -> Iterator[tuple[int, int, Path]]:
        """First row, number of rows and path of each file."""
        for first, extent in sorted(self._extents.items()):
            yield first, extent.bytes // self.row_bytes, self.path(first)

    def _append_to(self, start: int, content: memoryview) -> None:
        """Append whole rows to the file that begins at a row."""
        path, size = self.path(start), self._extents[start].bytes
        path.touch()
        with path.open("r+b") as file:
            if self._hasher is None:
                self._hasher = hashlib.sha256()
                for block in _blocks(file, size):
                    self._hasher.update(block)
            file.truncate(size)
            file.seek(size)
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        self._hasher.update(content)
        self._extents[start] = Extent(size + len(content), self._hasher.hexdigest())


@dataclass(frozen=True)
class Manifest:
    """What a save consists of.

    Attributes:
        kind: What is saved.
        format: Number of the format.
        note: Says in a few plain values what is saved.
        files: Size and checksum of every file beside the manifest, by name.
        logs: Committed part of each log, by path relative to the folder of all saves.
    """

    kind: str
    format: int
    note: Mapping[str, Any]
    files: Mapping[str, Extent]
    logs: Mapping[str, Extent]


def write_manifest(
    folder: Path,
    kind: str,
    version: int,
    note: Mapping[str, Any],
    logs: Mapping[str, Extent],
    names: Sequence[str] | None = None,
    suffix: str = "",
) -> None:
    """Flushes files of a folder to the disk, and writes their manifest last.

    Args:
        folder: Folder of the files.
        kind: What is saved.
        version: Number of the format.
        note: Says in a few plain values what is saved.
        logs: Committed part of each log.
        names: The files; None takes all files of the folder.
        suffix: End of the names of the files and of the manifest as they are now; the manifest leaves it out.
    """
    names = [path.name for path in folder.iterdir() if path.name != MANIFEST] if names is None else names
    for name in names:
        sync(folder / f"{name}{suffix}")
    files = {name: measure_file(folder / f"{name}{suffix}") for name in sorted(names)}
    text = _manifest_text(Manifest(kind, version, note, files, logs))
    write_synced(folder / (MANIFEST + suffix), text.encode())


def read_manifest(folder: Path, kind: str, version: int) -> Manifest:
    """The manifest of a folder.

    Raises:
        DamageError: It is missing or damaged, or describes something of another kind.
        UserError: The save has another format.
    """
    path = folder / MANIFEST
    try:
        if path.stat().st_size > LARGEST_MANIFEST:
            raise ValueError("it is too large")
        if not path.is_file():
            raise ValueError("it is not a regular file")
        text = path.read_text()
        values = json.loads(text)
        if not isinstance(values, dict) or set(values) != _KEYS:
            raise ValueError(f"it must hold {', '.join(sorted(_KEYS))}")
        files, logs = (_read_extents(values[name]) for name in ("files", "logs"))
        manifest = Manifest(values["kind"], values["format"], values["note"], files, logs)
        if text != _manifest_text(manifest):
            raise ValueError("its own checksum differs")
    except FileNotFoundError:
        raise DamageError(f"{path} is missing") from None
    except (OSError, ValueError, RecursionError) as error:
        reason = getattr(error, "strerror", None) or str(error).splitlines()[0][:120]
        raise DamageError(f"{path} is damaged: {reason}") from None
    if manifest.kind != kind:
        raise DamageError(f"{path} describes a {str(manifest.kind)[:40]}, not a {kind}")
    if manifest.format != version:
        raise UserError(
            f"{folder} has format {manifest.format}, this version of latentplan reads format {version}: "
            "continue with the version that saved it"
        )
    return manifest


def check_files(folder: Path, manifest: Manifest) -> None:
    """Compare the files of a folder with its manifest.

    Raises:
        DamageError: A file is missing, differs, or is not named by the manifest.
    """
    unknown = {path.name for path in folder.iterdir()} - set(manifest.files) - {MANIFEST}
    if unknown:
        raise DamageError(f"{folder / min(unknown)} is not named by {MANIFEST}")
    for name, extent in manifest.files.items():
        check_extent(folder / name, extent, is_whole=True)


def check_extent(path: Path, extent: Extent, *, is_whole: bool) -> None:
    """Compare the first bytes of a file with a checksum.

    Args:
        path: The file.
        extent: Number and checksum of the bytes.
        is_whole: Whether the file must end with these bytes.

    Raises:
        DamageError: The file is missing, too short, too long or damaged.
    """
    try:
        size = path.stat().st_size
        if size < extent.bytes or (is_whole and size > extent.bytes):
            raise DamageError(f"{path} is damaged: it has {size:,} bytes and must have {extent.bytes:,}")
        if measure_file(path, extent.bytes).sha256 != extent.sha256:
            raise DamageError(f"{path} is damaged: its checksum differs")
    except OSError as error:
        raise DamageError(f"{path} cannot be read: {error.strerror}") from None


def measure_file(path: Path, size: int | None = None) -> Extent:
    """Size and checksum of a file, or of its first bytes."""
    hasher, count = hashlib.sha256(), 0
    with path.open("rb") as file:
        for block in _blocks(file, size):
            hasher.update(block)
            count += len(block)
    return Extent(count, hasher.hexdigest())


def write_synced(path: Path, content: bytes) -> None:
    """Write a file and flush it to the disk."""
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def sync(path: Path) -> None:
    """Flush a file, or the names in a folder, to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _blocks(file: Any, size: int | None) -> Iterator[bytes]:
    left = size
    while left is None or left > 0:
        block = file.read(_BLOCK if left is None else min(_BLOCK, left))
        if not block:
            return
        left = None if left is None else left - len(block)
        yield block


def _manifest_text(manifest: Manifest) -> str:
    """The text of a manifest; it ends with the checksum of what it says."""
    parts = {
        name: {path: {"bytes": part.bytes, "sha256": part.sha256} for path, part in sorted(extents.items())}
        for name, extents in (("files", manifest.files), ("logs", manifest.logs))
    }
    body = {"kind": manifest.kind, "format": manifest.format, "note": dict(manifest.note), **parts}
    digest = hashlib.sha256(json.dumps(body).encode()).hexdigest()
    return json.dumps(body | {"sha256": digest}, indent=1) + "\n"


def _read_extents(values: Any) -> dict[str, Extent]:
    if not isinstance(values, dict):
        raise ValueError("a list of files is no list of files")
    extents = {}
    for name, value in values.items():
        if not _FILE.fullmatch(name):
            raise ValueError(f"it names the file {name[:80]!r}")
        if not (isinstance(value, dict) and isinstance(value.get("bytes"), int) and value["bytes"] >= 0):
            raise ValueError(f"it has no size of {name}")
        extents[name] = Extent(value["bytes"], str(value.get("sha256")))
    return extents
