"""Manifests: the sizes and SHA-256 checksums of files, by which any damage of them is noticed."""

from __future__ import annotations

import hashlib
import json
import os
import re
import stat
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from latentplan.config.checks import UserError
from latentplan.config.reading import read_bytes
from latentplan.config.writing import replaced_whole

MANIFEST = "manifest.json"
LOGS = "logs"  # folder of the logs, beside the saves
LARGEST_MANIFEST = 64 * 2**20
_FILE = re.compile(r"\w[\w.-]*")
_LOG = re.compile(rf"{LOGS}/\w[\w.-]*-[0-9]{{12}}")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_PLAIN = (str, int, float, bool, type(None))
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
    with replaced_whole(folder / (MANIFEST + suffix)) as part:
        write_synced(part, text.encode())


def read_manifest(folder: Path, kind: str, version: int) -> Manifest:
    """The manifest of a folder.

    Raises:
        DamageError: It is missing or damaged, or describes something of another kind.
        UserError: The save has another format.
    """
    path = folder / MANIFEST
    try:
        manifest = _parse_manifest(read_bytes(path, LARGEST_MANIFEST).decode())
    except UserError as error:
        is_missing = isinstance(error.__context__, FileNotFoundError)
        raise DamageError(f"{path} is missing" if is_missing else str(error)) from None
    except (ValueError, RecursionError) as error:
        raise DamageError(f"{path} is damaged: {str(error).splitlines()[0][:120]}") from None
    if manifest.kind != kind:
        raise DamageError(f"{path} describes a {manifest.kind[:40]}, not a {kind}")
    if manifest.format != version:
        raise UserError(
            f"{folder} has format {manifest.format}, this version of latentplan reads format {version}: "
            "continue with the version that saved it"
        )
    return manifest


def check_files(folder: Path, manifest: Manifest) -> None:
    """Compare the files of a folder with its manifest.

    Raises:
        DamageError: A file is missing, is a link, differs, or is not named by the manifest.
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
        DamageError: The file is missing, not a regular file, too short, too long or damaged.
    """
    try:
        found = path.lstat()  # a run also writes to its logs, and a link would lead it to a file of somebody else
        size = found.st_size
        if not stat.S_ISREG(found.st_mode):
            raise DamageError(f"{path} is damaged: it is not a regular file")
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
        for block in read_blocks(file, size):
            hasher.update(block)
            count += len(block)
    return Extent(count, hasher.hexdigest())


def write_synced(path: Path, content: bytes | memoryview) -> None:
    """Writes a new file in place of whatever has its name, and flushes the file to the disk; no link is followed."""
    path.unlink(missing_ok=True)
    with path.open("xb") as file:
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


def read_blocks(file: Any, size: int | None) -> Iterator[bytes]:
    """The first bytes of an open file, or all of them, in blocks of 1 MiB."""
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


def _parse_manifest(text: str) -> Manifest:
    """The manifest that a text describes.

    Raises:
        ValueError: The text describes something else, or its own checksum differs.
    """
    values = json.loads(text)
    if not isinstance(values, dict) or set(values) != _KEYS:
        raise ValueError(f"it must hold {', '.join(sorted(_KEYS))}")
    kind, version, note = (values[name] for name in ("kind", "format", "note"))
    if not isinstance(kind, str) or type(version) is not int:
        raise ValueError("kind must be a text, and format a whole number")
    if not isinstance(note, dict) or not all(isinstance(value, _PLAIN) for value in note.values()):
        raise ValueError("note must hold plain values")
    files, logs = _read_extents(values["files"], _FILE), _read_extents(values["logs"], _LOG)
    manifest = Manifest(kind, version, note, files, logs)
    if text != _manifest_text(manifest):
        raise ValueError("its own checksum differs")
    return manifest


def _read_extents(values: Any, names: re.Pattern[str]) -> dict[str, Extent]:
    if not isinstance(values, dict):
        raise ValueError("a list of files is no list of files")
    extents = {}
    for name, value in values.items():
        if not names.fullmatch(name):
            raise ValueError(f"it names the file {name[:80]!r}")
        if not isinstance(value, dict) or type(value.get("bytes")) is not int or value["bytes"] < 0:
            raise ValueError(f"it has no size of {name}")
        if not isinstance(value.get("sha256"), str) or not _SHA256.fullmatch(value["sha256"]):
            raise ValueError(f"it has no checksum of {name}")
        extents[name] = Extent(value["bytes"], value["sha256"])
    return extents
