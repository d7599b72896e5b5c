"""Pixels from simulators: one environment, several at once, or one of the user's own."""

from __future__ import annotations

from latentplan.envs.gl import choose_backend, render_info
from latentplan.envs.suite import SuiteEnv, default_task
from latentplan.envs.user import PixelEnv, make_from, wrap_user_env
from latentplan.envs.vector import make_env, make_vector_env, single_threaded_children

__all__ = [
    "PixelEnv",
    "SuiteEnv",
    "default_task",
    "make_env",
    "make_from",
    "make_vector_env",
    "render_info",
    "single_threaded_children",
    "wrap_user_env",
]

choose_backend()  # before anything imports MuJoCo
