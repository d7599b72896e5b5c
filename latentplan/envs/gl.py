"""Choice of the OpenGL backend before MuJoCo is imported, and facts about the renderer.

MuJoCo and dm_control read `MUJOCO_GL` when they are imported. Without the variable they choose a windowed backend,
which fails at the first frame on a machine without a display. This module therefore imports both inside functions.
"""

from __future__ import annotations

import ctypes.util
import functools
import glob
import os
import subprocess
import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING

from latentplan.config import UserError
from latentplan.config.extras import describe_missing

if TYPE_CHECKING:
    from collections.abc import Iterator

REMEDY = (
    "install software rendering (apt-get install -y libegl1 libgl1, and libosmesa6 where there is one) or set "
    "MUJOCO_GL=egl|osmesa|glfw"
)
_SOFTWARE_RENDERERS = ("llvmpipe", "softpipe", "swrast", "software")
_PROBE_TIMEOUT_S = 30.0
_PROBE_PROGRAM = (
    "import mujoco; from OpenGL import GL; context = mujoco.GLContext(64, 64); context.make_current(); "
    "print(GL.glGetString(GL.GL_RENDERER).decode())"
)


def choose_backend() -> str | None:
    """Sets `MUJOCO_GL` for this process and its children, unless it is set; also limits the renderers' threads.

    Hardware EGL comes first, then OSMesa, then EGL in software. Nothing is probed when `MUJOCO_GL` is set, so child
    processes inherit the choice at no cost.

    Returns:
        The backend that MuJoCo will use, or None where no OpenGL library was found.
    """
    # dm_control's rendering thread prints errors at exit, and does not make one environment faster.
    os.environ.setdefault("DISABLE_RENDER_THREAD_OFFLOADING", "1")
    # Mesa's worker threads do not make small frames faster, and learning needs the cores.
    os.environ.setdefault("LP_NUM_THREADS", "0")
    backend = os.environ.get("MUJOCO_GL") or _find_backend()
    if backend:
        os.environ["MUJOCO_GL"] = backend
    return backend or None


def require_backend() -> str:
    """The chosen backend.

    Raises:
        UserError: No OpenGL library was found.
    """
    backend = choose_backend()
    if backend is None:
        raise UserError(f"no OpenGL library found to render with; {REMEDY}")
    return backend


@contextmanager
def explain_gl_errors() -> Iterator[None]:
    """Turns any error of an OpenGL library, or a library that is missing, into a `UserError` with its remedy.

    Raises:
        UserError: The body of the `with` block raised while it imported a backend or made a context.
    """
    try:
        yield
    except UserError:
        raise
    except ModuleNotFoundError as error:
        raise UserError(describe_missing(str(error.name), "rendering")) from error
    except Exception as error:  # each backend raises other types
        backend = os.environ.get("MUJOCO_GL")
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise UserError(f"cannot render with MUJOCO_GL={backend}: {reason}; {REMEDY}") from error


@functools.cache
def render_info() -> dict[str, str | bool]:
    """Facts about the renderer of the frames.

    Returns:
        `backend` (the value of MUJOCO_GL), `renderer` (the name that OpenGL reports), `hardware` (whether the renderer
        is a graphics processor) and `mujoco` (the version of MuJoCo: frames differ between versions).

    Raises:
        UserError: No OpenGL context can be made.
    """
    backend = require_backend()
    with explain_gl_errors():
        import mujoco
        from dm_control import _render
        from OpenGL import GL

        context = _render.Renderer(64, 64)
        with context.make_current() as gl:
            renderer = gl.call(GL.glGetString, GL.GL_RENDERER).decode()
        context.free()
    return {
        "backend": backend,
        "renderer": renderer,
        "hardware": is_hardware(renderer),
        "mujoco": mujoco.__version__,
    }


def is_hardware(renderer: str) -> bool:
    """Whether the name of an OpenGL renderer belongs to a graphics processor."""
    return bool(renderer) and not any(name in renderer.lower() for name in _SOFTWARE_RENDERERS)


def _find_backend() -> str | None:
    if sys.platform == "darwin":
        return "glfw"
    has_egl = ctypes.util.find_library("EGL") is not None
    if has_egl and _has_graphics_device() and is_hardware(_probe_egl()):
        return "egl"
    if ctypes.util.find_library("OSMesa") is not None:
        return "osmesa"
    return "egl" if has_egl else None


def _has_graphics_device() -> bool:
    return bool(glob.glob("/dev/nvidia[0-9]*") or glob.glob("/dev/dri/renderD*"))


def _probe_egl() -> str:
    """The name of EGL's renderer, empty where EGL fails; read in a child process, because a bad driver may crash it."""
    environment = {**os.environ, "MUJOCO_GL": "egl", "PYOPENGL_PLATFORM": "egl"}
    try:
        probe = subprocess.run(
            [sys.executable, "-c", _PROBE_PROGRAM],
            env=environment,
            capture_output=True,
            text=True,
            timeout=_PROBE_TIMEOUT_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return probe.stdout.strip() if probe.returncode == 0 else ""
