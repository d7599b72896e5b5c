"""The files of a checkpoint, written as one commit and compared with their manifest when they are read.

A checkpoint keeps its place and the names of its files, so a new one cannot be renamed as a folder. New files are
written beside the old ones under the suffix `.part`; the commit is the renaming of the new manifest, and the other
files are renamed after it. A reader takes of each file the one that the manifest names, with or without the suffix, so
that a checkpoint is whole at every moment, also after a crash between two renamings.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from latentplan.config import UserError
from latentplan.config.commit import MANIFEST, PART, DamageError, Manifest, read_manifest, sync, write_manifest
from latentplan.config.reading import read_bytes

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
    if (folder / MANIFEST).exists():
        _finish_renaming(folder)
    for name, content in contents.items():
        (folder / f"{name}{PART}").write_bytes(content)
    write_manifest(folder, KIND, FORMAT, {}, {}, names=list(contents), suffix=PART)
    (folder / f"{MANIFEST}{PART}").replace(folder / MANIFEST)
    sync(folder)
    for name in contents:
        (folder / f"{name}{PART}").replace(folder / name)
    sync(folder)


def seal(folder: Path, names: Sequence[str]) -> None:
    """Writes the manifest of a checkpoint whose files were changed on purpose, or that has none."""
    write_manifest(folder, KIND, FORMAT, {}, {}, names=names)


def read_files(folder: Path, names: Sequence[str]) -> dict[str, bytes]:
    """The content of files of a checkpoint, by name; compared with the manifest if there is one.

    Raises:
        UserError: A file cannot be read, or differs from what the manifest says of it.
    """
    for attempt in range(TRIES):
        has_manifest = (folder / MANIFEST).exists()
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
    """Whether a folder holds all files of a checkpoint."""
    return all((folder / name).is_file() or (folder / f"{name}{PART}").is_file() for name in names)


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


def _finish_renaming(folder: Path) -> None:
    """Do what is left of an earlier commit, before its files are overwritten."""
    try:
        manifest = read_manifest(folder, KIND, FORMAT)
        for name in manifest.files:
            path, _ = _find(folder, name, manifest)
            if path.name != name:
                path.replace(folder / name)
    except UserError:
        return  # a damaged checkpoint is replaced


def _read(path: Path) -> bytes:
    try:
        return read_bytes(path, LARGEST.get(path.name.removesuffix(PART), LARGEST_FILE))
    except UserError as error:
        if isinstance(error.__context__, FileNotFoundError):  # a renaming may have come between
            raise DamageError(str(error)) from None
        raise
