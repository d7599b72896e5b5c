"""Environments with camera frames as observations: registered suites, vector environments, the user's own."""

from __future__ import annotations

from latentplan.envs.gl import choose_backend, render_info
from latentplan.envs.registry import default_task, make_env
from latentplan.envs.suite import SuiteEnv
from latentplan.envs.threads import single_threaded_children
from latentplan.envs.user import PixelEnv, make_from, wrap_user_env
from latentplan.envs.vector import make_vector_env

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

choose_backend()  # has to happen before MuJoCo is imported
