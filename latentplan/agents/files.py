"""The files of a checkpoint, written as one commit and compared with their manifest when they are read.

A checkpoint keeps its place and the names of its files, so a new one cannot be renamed as a folder. New files are
written beside the old ones under the suffix `.part`; the commit is the renaming of the new manifest, and the other
files are renamed after it. A reader takes of each file the one that the manifest names, with or without the suffix, so
that a checkpoint is whole at every moment, also after a crash between two renamings.
"""

from __future__ import annotations

import contextlib
import hashlib
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from latentplan.config import UserError
from latentplan.config.commit import PART
from latentplan.config.manifest import (
    MANIFEST,
    DamageError,
    Manifest,
    read_manifest,
    sync,
    write_manifest,
    write_synced,
)
from latentplan.config.reading import read_bytes
from latentplan.config.writing import remove_parts

WEIGHTS = "weights.safetensors"
INFO = "info.json"
CARD = "README.md"  # describes the agent to people; not part of it, and in no manifest
FILM = "replay.mp4"  # of the card; the model hub plays a film of this name beside the card
LARGEST_FILE = 2**32  # bytes; weights of the shipped agents have some millions
LARGEST = {INFO: 2**24, WEIGHTS: LARGEST_FILE}  # bytes; a description with the metrics of a long run has some 2**19
KIND, FORMAT = "agent", 1
TRIES, PAUSE_SECONDS = 5, 0.1  # while another process replaces the checkpoint


def write_files(folder: Path, contents: Mapping[str, bytes]) -> None:
    """Replaces the files of a checkpoint as one commit; other files in the folder stay.

    Args:
        folder: Folder of the checkpoint; a missing folder is made.
        contents: Content of each file, by name.
    """
    folder.mkdir(parents=True, exist_ok=True)
    finish_renaming(folder)
    try:
        for name, content in contents.items():
            write_synced(folder / f"{name}{PART}", content)
        write_manifest(folder, KIND, FORMAT, {}, {}, names=list(contents), suffix=PART)
    except BaseException:  # a full disk needs the room
        _remove_parts(folder, contents)
        raise
    (folder / f"{MANIFEST}{PART}").replace(folder / MANIFEST)
    sync(folder)
    for name in contents:
        (folder / f"{name}{PART}").replace(folder / name)
    sync(folder)


def seal(folder: Path, names: Sequence[str]) -> None:
    """Writes the manifest of a checkpoint whose files were changed on purpose, or that has none."""
    write_manifest(folder, KIND, FORMAT, {}, {}, names=names)
    sync(folder)


def finish_renaming(folder: Path) -> bool:
    """Does what is left of a commit that was cut off after the renaming of its manifest.

    Returns:
        Whether no file with the suffix is part of the checkpoint any more; false where the manifest cannot be read.
    """
    if not (folder / MANIFEST).exists():
        return True
    try:
        manifest = read_manifest(folder, KIND, FORMAT)
    except UserError:
        return False
    for name in manifest.files:
        with contextlib.suppress(UserError):  # a damaged file stays where it is
            path, _ = _find(folder, name, manifest)
            if path.name != name:
                path.replace(folder / name)
    return True


def remove_leftovers(folder: Path, names: Iterable[str]) -> None:
    """Removes what commits left that were cut off before the renaming of their manifest, and finishes later ones.

    Args:
        folder: Folder of the checkpoint; it need not exist.
        names: The files of a checkpoint.
    """
    remove_parts(folder / f"{MANIFEST}{PART}")
    if finish_renaming(folder):
        _remove_parts(folder, names)


def read_files(folder: Path, names: Sequence[str], *, is_sealed: bool = True) -> dict[str, bytes]:
    """The content of files of a checkpoint, by name; compared with the manifest if there is one.

    Args:
        folder: Folder of the checkpoint.
        names: The files.
        is_sealed: Whether the manifest counts; without it the files are read as they are.

    Raises:
        UserError: A file cannot be read, or differs from what the manifest says of it.
    """
    for attempt in range(TRIES):
        has_manifest = is_sealed and (folder / MANIFEST).exists()
        try:
            if not has_manifest:
                return {name: _read(folder / name) for name in names}
            manifest = read_manifest(folder, KIND, FORMAT)
            return {name: _find(folder, name, manifest)[1] for name in names}
        except DamageError:
            if not has_manifest or attempt == TRIES - 1:
                raise
            time.sleep(PAUSE_SECONDS)
    raise AssertionError("the last attempt returns or raises")


def is_checkpoint(folder: Path, names: Sequence[str]) -> bool:
    """Whether a folder holds all files of a checkpoint; without a manifest, files with the suffix are none."""
    suffixes = ("", PART) if (folder / MANIFEST).is_file() else ("",)
    return all(any((folder / f"{name}{suffix}").is_file() for suffix in suffixes) for name in names)


def _find(folder: Path, name: str, manifest: Manifest) -> tuple[Path, bytes]:
    """The path and the content of the file that the manifest describes."""
    if name not in manifest.files:
        raise DamageError(f"{folder / MANIFEST} does not name {name}")
    for path in (folder / name, folder / f"{name}{PART}"):
        if path.exists():
            content = _read(path)
            if hashlib.sha256(content).hexdigest() == manifest.files[name].sha256:
                return path, content
    raise DamageError(
        f"{folder / name} is damaged: its checksum differs from the checksum in {MANIFEST}; after a deliberate change, "
        "delete that file"
    )


def _remove_parts(folder: Path, names: Iterable[str]) -> None:
    for name in (*names, MANIFEST):
        (folder / f"{name}{PART}").unlink(missing_ok=True)


def _read(path: Path) -> bytes:
    try:
        return read_bytes(path, LARGEST.get(path.name.removesuffix(PART), LARGEST_FILE))
    except UserError as error:
        if isinstance(error.__context__, FileNotFoundError):  # a renaming may have come between
            raise DamageError(str(error)) from None
        raise
