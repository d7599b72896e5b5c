"""The OpenGL backend is chosen before MuJoCo is imported, and errors name a remedy."""

import ctypes.util

import pytest

from latentplan.config import UserError
from latentplan.envs import gl, render_info

QUIET = """
import sys
from latentplan.config import EnvConfig
from latentplan.envs import make_env
assert not {"mujoco", "dm_control"} & set(sys.modules)
env = make_env(EnvConfig(domain="cheetah", render_quality="fastest"), seed=0)
env.reset()
"""
BROKEN = """
import os
os.environ["MUJOCO_GL"] = "cardboard"
from latentplan.config import EnvConfig, UserError
from latentplan.envs import make_env
try:
    make_env(EnvConfig())
except UserError as error:
    print(error)
"""


def test_choose_backend_keeps_the_users_choice(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    assert gl.choose_backend() == "glfw"


@pytest.mark.parametrize(
    ("libraries", "device", "egl_renderer", "expected"),
    [
        ({"EGL", "OSMesa"}, True, "NVIDIA H200/PCIe/SSE2", "egl"),
        ({"EGL", "OSMesa"}, True, "llvmpipe (LLVM 15)", "osmesa"),
        ({"EGL", "OSMesa"}, True, "", "osmesa"),
        ({"EGL", "OSMesa"}, False, "unasked", "osmesa"),
        ({"EGL"}, False, "unasked", "egl"),
        (set(), True, "unasked", None),
    ],
)
def test_find_backend_prefers_hardware_then_osmesa_then_mesa(monkeypatch, libraries, device, egl_renderer, expected):
    monkeypatch.setattr(gl.sys, "platform", "linux")
    monkeypatch.setattr(ctypes.util, "find_library", lambda name: name if name in libraries else None)
    monkeypatch.setattr(gl, "_has_graphics_device", lambda: device)
    monkeypatch.setattr(gl, "_probe_egl", lambda: egl_renderer)
    assert gl._find_backend() == expected


def test_require_backend_names_the_remedy_without_opengl(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL")
    monkeypatch.setattr(gl, "_find_backend", lambda: None)
    with pytest.raises(UserError, match="apt-get install -y libegl1 libgl1, and libosmesa6"):
        gl.require_backend()


def test_make_env_explains_a_backend_that_does_not_exist_in_one_line(run_python):
    finished = run_python("-c", BROKEN)
    assert finished.returncode == 0, finished.stderr
    assert finished.stdout.startswith("cannot render with MUJOCO_GL=cardboard: ")
    assert len(finished.stdout.splitlines()) == 1


def test_program_ends_without_output_when_it_does_not_close_its_environment(run_python):
    finished = run_python("-c", QUIET)
    assert (finished.returncode, finished.stdout, finished.stderr) == (0, "", "")


def test_render_info_names_backend_renderer_and_mujoco():
    info = render_info()
    assert info["backend"] and info["renderer"] and info["mujoco"]
    assert info["hardware"] == gl.is_hardware(info["renderer"])
