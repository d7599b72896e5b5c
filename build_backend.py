"""Build backend: setuptools, except that an editable install also brings the extra `train`.

An installed package is a library: it brings what planning and trained agents need. An editable install is a checkout,
whose scripts train and evaluate, so `pip install -e .` brings everything that they need.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from setuptools import build_meta
from setuptools.build_meta import (  # noqa: F401
    build_sdist,
    build_wheel,
    get_requires_for_build_editable,
    get_requires_for_build_sdist,
    get_requires_for_build_wheel,
    prepare_metadata_for_build_wheel,
)

EXTRA = 'extra == "train"'


def prepare_metadata_for_build_editable(folder: str, settings: dict[str, Any] | None = None) -> str:
    """Writes the metadata of an editable install and returns the name of their folder in `folder`."""
    name = build_meta.prepare_metadata_for_build_editable(folder, settings)
    metadata = Path(folder, name, "METADATA")
    lines = metadata.read_text(encoding="utf-8").splitlines(keepends=True)
    metadata.write_text("".join(map(_without_extra, lines)), encoding="utf-8")
    return name


def build_editable(folder: str, settings: dict[str, Any] | None = None, metadata: str | None = None) -> str:
    """Builds the wheel of an editable install in `folder` and returns its name."""
    with TemporaryDirectory() as made:
        if metadata is None:
            metadata = str(Path(made, prepare_metadata_for_build_editable(made, settings)))
        return build_meta.build_editable(folder, settings, metadata)


def _without_extra(line: str) -> str:
    """The line of a requirement without the condition that the extra `train` is asked for."""
    if not line.startswith("Requires-Dist:"):
        return line
    return line.replace(f" and {EXTRA}", "").replace(f"; {EXTRA}", "")
