"""Reads and changes the files of a run folder."""

import csv
import hashlib
from pathlib import Path

import torch

from latentplan.config.commit import MANIFEST, read_manifest, write_manifest
from latentplan.config.run_folder import RUN_FORMAT


def read_rows(folder):
    with (folder / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def read_epochs(folder):
    """The rows of epochs, without the rows of evaluations."""
    return [row for row in read_rows(folder) if row["reconstruction"]]


def list_saves(folder):
    """The saves in a folder, from the oldest to the newest."""
    return sorted(Path(folder, "resume").glob("save-*[0-9]"))


def read_state(folder):
    return torch.load(list_saves(folder)[-1] / "state.pt", weights_only=True)


def write_state(folder, state, kind="run"):
    """Changes the state of the newest save, as if the run had saved it."""
    save = list_saves(folder)[-1]
    torch.save(state, save / "state.pt")
    seal(save, kind)


def seal(save, kind="run"):
    """Makes the manifest of a save fit its changed files."""
    old = read_manifest(save, kind, RUN_FORMAT)
    (save / MANIFEST).unlink()
    write_manifest(save, kind, RUN_FORMAT, old.note, old.logs)


def fingerprint(folder):
    """Checksum of everything that a run has learned, collected and measured, without times."""
    save, hasher = list_saves(folder)[-1], hashlib.sha256()
    state = read_state(folder)
    parts = [state[name] for name in ("learner", "optimizers", "memory", "requests")]
    rows = torch.load(save / "rows.pt", weights_only=True)
    clocks = {name: value for name, value in state["run"].items() if name != "earlier_minutes"}
    _feed(hasher, [parts, rows, clocks, read_rows(folder)])
    for path in sorted(Path(folder, "resume", "logs").iterdir()):
        hasher.update(path.read_bytes())
    return hasher.hexdigest()


def _feed(hasher, value):
    if isinstance(value, dict):
        for name, inner in value.items():
            if name != "minutes":
                hasher.update(str(name).encode())
                _feed(hasher, inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            _feed(hasher, inner)
    elif isinstance(value, torch.Tensor):
        hasher.update(value.contiguous().numpy().tobytes())
    else:
        hasher.update(repr(value).encode())
