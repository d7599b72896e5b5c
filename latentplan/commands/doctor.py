"""`latentplan doctor`: report what this machine offers for training, and how to mend each problem."""

from __future__ import annotations

import importlib.metadata
import platform
import re
import shutil
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from latentplan.config import RENDER_QUALITIES, EnvConfig, UserError
from latentplan.config.estimates import count_cores
from latentplan.config.extras import DM_CONTROL
from latentplan.config.origin import processor_name

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

_REQUIRED = (
    "torch",
    "numpy",
    "einops",
    "gymnasium",
    "mujoco",
    "dm-control",
    "opencv-python-headless",
    "safetensors",
    "lightning",
    "jsonargparse",
    "rich",
    "matplotlib",
    "tensorboard",
)
_BAD_VERSIONS = {
    "mujoco": (("4.",), "pip install 'mujoco<4': dm_control does not work with 4"),
    "lightning": (("2.6.2", "2.6.3"), "pip install 'lightning>=2.6.6': this release was compromised"),
}
_GIB = 2**30
_ENOUGH_MEMORY_GIB = 4.0
_ENOUGH_DISK_GIB = 2.0
_TIMED_FRAMES = 20
_VIDEO_FRAMES = 8


@dataclass(frozen=True)
class Request:
    """The doctor has no flags of its own."""


@dataclass(frozen=True)
class Finding:
    """One line of the report.

    Attributes:
        name: Part of the machine that was checked.
        value: State of that part.
        problem: Remedy of the problem; None where nothing is wrong.
        fatal: Whether the problem prevents training.
    """

    name: str
    value: str
    problem: str | None = None
    fatal: bool = True


def run(request: Request) -> int:
    """Print the report.

    Returns:
        0 where everything that training needs works, else 1.
    """
    findings = []
    for check in (_versions, _device, _kernels, _renderer, _frame_times, _space, _video):
        for finding in _guarded(check):
            findings.append(finding)
            print(f"{'ok ' if finding.problem is None else '-> '} {finding.name:<24} {finding.value}", flush=True)
    problems = [finding for finding in findings if finding.problem is not None]
    for finding in problems:
        print(f"{'fix' if finding.fatal else 'note'}: {finding.name}: {finding.problem}")
    if not problems:
        print("everything works")
    return int(any(finding.fatal for finding in problems))


def _guarded(check: Callable[[], Iterator[Finding]]) -> Iterator[Finding]:
    """The findings of a check, the last of them its failure if it fails: the report must always end."""
    try:
        yield from check()
    except UserError as error:
        yield Finding(_title(check), "does not work", str(error))
    except ImportError as error:
        yield Finding(_title(check), f"cannot import {error.name}", "pip install -e . in the project's folder")
    except Exception as error:  # drivers and libraries raise errors of any type
        yield Finding(_title(check), "failed", f"{type(error).__name__}: {error}")


def _title(check: Callable[[], Iterator[Finding]]) -> str:
    return check.__name__.strip("_").replace("_", " ")


def _versions() -> Iterator[Finding]:
    from latentplan import __version__

    yield Finding("latentplan", __version__)
    old = sys.version_info < (3, 11)
    yield Finding("python", platform.python_version(), "use Python 3.11 or newer" if old else None)
    for name in _REQUIRED:
        try:
            version = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            yield Finding(name, "missing", f"pip install {_to_install(name)}")
            continue
        bad, remedy = _BAD_VERSIONS.get(name, ((), ""))
        yield Finding(name, version, remedy if version.startswith(bad) and bad else None)


def _to_install(name: str) -> str:
    """What pip has to install for a package that is missing: the range of versions that this one allows."""
    if name == "dm-control" and sys.version_info >= (3, 13):
        return DM_CONTROL
    try:
        requirements = importlib.metadata.requires("latentplan") or []
    except importlib.metadata.PackageNotFoundError:  # a checkout that is not installed
        requirements = []
    found = next((text for text in requirements if re.split(r"[^\w.-]", text)[0] == name), name)
    return f"'{found.partition(';')[0].strip()}'"


def _device() -> Iterator[Finding]:
    yield Finding("processor", f"{processor_name()}, {count_cores()} cores")
    import torch

    if torch.cuda.is_available():
        device = torch.cuda.get_device_properties(0)
        yield Finding("cuda", f"{device.name}, {device.total_memory / _GIB:.0f} GiB")
    elif Path("/dev/nvidiactl").exists():
        remedy = "install a CUDA build of torch, or a driver that matches it: https://pytorch.org/get-started"
        yield Finding("cuda", "torch cannot use this machine's NVIDIA card", remedy, fatal=False)
    else:
        yield Finding("cuda", "none; training runs on the processor")


def _kernels() -> Iterator[Finding]:
    from latentplan.models.fast.library import load

    remedy = "no C compiler with OpenMP (cc, gcc, clang or $CC) works here; with one, planning takes half the time"
    compiled = load() is not None
    yield Finding("planner's kernels", "compiled" if compiled else "torch", None if compiled else remedy, fatal=False)


def _renderer() -> Iterator[Finding]:
    from latentplan.envs import render_info

    info = render_info()
    kind = "hardware" if info["hardware"] else "software"
    yield Finding("renderer", f"{info['renderer']} ({kind}, MUJOCO_GL={info['backend']})", _slow_renderer(info), False)


def _slow_renderer(info: dict[str, str | bool]) -> str | None:
    if info["hardware"] or not Path("/dev/nvidiactl").exists():
        return None
    return (
        "frames are drawn in software although there is a graphics card; install its EGL driver "
        "(libnvidia-gl; in a container set NVIDIA_DRIVER_CAPABILITIES=all)"
    )


def _frame_times() -> Iterator[Finding]:
    from latentplan.envs import make_env

    for quality in RENDER_QUALITIES:
        env = make_env(EnvConfig(render_quality=quality), seed=0)
        try:
            env.reset()
            durations_ms = []
            for _ in range(_TIMED_FRAMES):
                start = time.perf_counter()
                env.render()
                durations_ms.append(1e3 * (time.perf_counter() - start))
        finally:
            env.close()
        yield Finding(f"frame, {quality}", f"{sorted(durations_ms)[_TIMED_FRAMES // 2]:.2f} ms (walker, 64 x 64)")


def _space() -> Iterator[Finding]:
    from latentplan.replay.memory import MEMORY_FACTS, free_memory

    if MEMORY_FACTS.exists():  # other systems do not say how much is free
        memory = free_memory() / _GIB
        short = memory < _ENOUGH_MEMORY_GIB
        remedy = f"below {_ENOUGH_MEMORY_GIB:g} GiB: lower --replay.capacity, or end other programs"
        yield Finding("memory available", f"{memory:.1f} GiB", remedy if short else None, fatal=False)
    disk = shutil.disk_usage(Path.cwd()).free / _GIB
    short = disk < _ENOUGH_DISK_GIB
    remedy = f"below {_ENOUGH_DISK_GIB:g} GiB: free some, or write elsewhere with --run-dir"
    yield Finding("disk free here", f"{disk:.1f} GiB", remedy if short else None, fatal=False)


def _video() -> Iterator[Finding]:
    import cv2
    import numpy as np

    # VideoWriter never raises: only reading the film back shows whether it was written.
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "film.mp4")
        writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"vp09"), 25.0, (64, 64))
        for index in range(_VIDEO_FRAMES):
            writer.write(np.full((64, 64, 3), 20 * index, dtype=np.uint8))
        writer.release()
        reader = cv2.VideoCapture(path)
        num_read = 0
        while reader.read()[0]:
            num_read += 1
        reader.release()
    broken = num_read != _VIDEO_FRAMES
    remedy = "pip install --force-reinstall opencv-python-headless: its wheel writes VP9"
    yield Finding("video (VP9)", f"{num_read} of {_VIDEO_FRAMES} frames read back", remedy if broken else None, False)
