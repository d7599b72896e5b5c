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
import os
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from latentplan.config.checks import UserError, make_folder
from latentplan.config.manifest import (
    LARGEST_MANIFEST,
    LOGS,
    MANIFEST,
    DamageError,
    Extent,
    check_extent,
    check_files,
    read_blocks,
    read_manifest,
    sync,
    write_manifest,
)
from latentplan.config.reading import parse_json, read_text

PART = ".part"
_NAME = re.compile(r"save-(\d{6,})")


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
            path = self.folder / f"save-{number:06d}" / MANIFEST
            with contextlib.suppress(UserError, TypeError, KeyError):
                kinds.add(str(parse_json(read_text(path, LARGEST_MANIFEST), path)["kind"]))
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
            remove(part)
            part.mkdir()
            logs = write(part)
            write_manifest(part, self.kind, self.version, note, logs)
            sync(part)
            part.rename(final)
        except BaseException:
            remove(part)
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
            remove(path)

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
                remove(self.folder / name)
        for path in (self.folder / LOGS).glob("*"):
            if f"{LOGS}/{path.name}" not in logs:
                path.unlink(missing_ok=True)


class Log:
    """Rows of equal size, numbered from 0 and appended to files of at most `rows_per_file` rows.

    The files are named by their first row. Rows that were appended stay as they are; whole files of rows that are no
    longer needed leave the log. A file that another program has changed is noticed by its size and time; see
    `forget_changed`.

    Args:
        folder: Folder of all saves.
        name: Begins the names of the files.
        row_bytes: Size of a row.
        rows_per_file: Rows in a file.
    """

    def __init__(self, folder: Path, name: str, row_bytes: int, rows_per_file: int = 1024) -> None:
        self.folder, self.name, self.row_bytes, self.rows_per_file = folder, name, row_bytes, rows_per_file
        self._extents: dict[int, Extent] = {}  # by the first row of the file
        self._looks: dict[int, tuple[int, ...]] = {}  # of each file when this log last read or wrote it
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
            DamageError: The last file has lost rows.
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
            touched = [start for start, extent in self._extents.items() if extent != before.get(start)]
            touched += sorted(self._extents)[-1:]
            self._extents, self._hasher = before, None
            for first in touched:  # a full disk needs the room; other files may belong to the save before
                with contextlib.suppress(OSError), self._open(first, os.O_RDWR) as file:
                    file.truncate(before[first].bytes if first in before else 0)
            raise

    def forget_changed(self) -> Path | None:
        """Forgets the first file that another program has changed, and all files of later rows.

        The rows from there on have to be appended again. A file of the same size and time is taken as unchanged; of
        another file, the checksum of the committed part counts.

        Returns:
            The changed file; None without one.
        """
        for first in sorted(self._extents):
            if self._has_changed(first):
                self._extents = {other: extent for other, extent in self._extents.items() if other < first}
                self._hasher = None
                return self.path(first)
        return None

    def drop_before(self, row: int) -> None:
        """Forget files whose rows all come before a row."""
        for first in sorted(self._extents)[:-1]:
            if first + self._extents[first].bytes // self.row_bytes <= row:
                del self._extents[first]

    def extents(self) -> dict[str, Extent]:
        """The committed part of each file, by path relative to the folder of all saves."""
        return {str(self.path(first).relative_to(self.folder)): part for first, part in self._extents.items()}

    def restore(self, logs: Mapping[str, Extent]) -> None:
        """Continue after the rows that a save committed; later rows are overwritten.

        Args:
            logs: The committed parts, which `Saves.newest` has compared with the files.

        Raises:
            DamageError: A committed part does not hold whole rows.
        """
        prefix = f"{LOGS}/{self.name}-"
        self._extents = {
            int(name.removeprefix(prefix)): extent for name, extent in logs.items() if name.startswith(prefix)
        }
        if any(extent.bytes % self.row_bytes for extent in self._extents.values()):
            raise DamageError(f"{self.folder / prefix}* are damaged: they do not hold whole rows")
        self._hasher = None
        self._looks = {first: _look(self.path(first).lstat()) for first in self._extents}

    def rows(self) -> Iterator[tuple[int, int, Path]]:
        """First row, number of rows and path of each file."""
        for first, extent in sorted(self._extents.items()):
            yield first, extent.bytes // self.row_bytes, self.path(first)

    def _append_to(self, start: int, content: memoryview) -> None:
        """Append whole rows to the file that begins at a row."""
        size = self._extents[start].bytes
        if size == 0:
            self.path(start).unlink(missing_ok=True)
        with self._open(start, os.O_RDWR if size else os.O_RDWR | os.O_CREAT | os.O_EXCL) as file:
            if os.fstat(file.fileno()).st_size < size:
                raise DamageError(f"{self.path(start)} is damaged: it has lost rows while the run goes on")
            if self._hasher is None:
                self._hasher = hashlib.sha256()
                for block in read_blocks(file, size):
                    self._hasher.update(block)
            file.truncate(size)
            file.seek(size)
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
            self._looks[start] = _look(os.fstat(file.fileno()))
        self._hasher.update(content)
        self._extents[start] = Extent(size + len(content), self._hasher.hexdigest())

    def _open(self, first: int, flags: int) -> BinaryIO:
        """Opens the file that begins with a row; a link, which would lead to a file of somebody else, is refused."""
        return os.fdopen(os.open(self.path(first), flags | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666), "r+b")

    def _has_changed(self, first: int) -> bool:
        path = self.path(first)
        with contextlib.suppress(FileNotFoundError):
            look = _look(path.lstat())
            if look == self._looks.get(first):
                return False
            with contextlib.suppress(DamageError):
                check_extent(path, self._extents[first], is_whole=False)
                self._looks[first] = look
                return False
        return True


def remove(path: Path) -> None:
    """Removes a folder with all that is in it, or a file, or a link; a folder that cannot be removed stays."""
    if path.is_symlink() or not path.is_dir():
        path.unlink(missing_ok=True)
    else:
        shutil.rmtree(path, ignore_errors=True)


def _look(found: os.stat_result) -> tuple[int, ...]:
    return found.st_ino, found.st_size, found.st_mtime_ns
