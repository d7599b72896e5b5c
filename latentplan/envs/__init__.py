"""Environments with camera frames as observations: registered suites, vector environments, the user's own."""

from __future__ import annotations

from latentplan.config.extras import require_extra

require_extra("latentplan.envs", "gymnasium", "mujoco", "cv2")

from latentplan.envs.gl import choose_backend, render_info  # noqa: E402
from latentplan.envs.registry import default_task, make_env  # noqa: E402
from latentplan.envs.spaces import accept_spaces  # noqa: E402
from latentplan.envs.suite import SuiteEnv  # noqa: E402
from latentplan.envs.threads import single_threaded_children  # noqa: E402
from latentplan.envs.user import PixelEnv, make_from, wrap_user_env  # noqa: E402
from latentplan.envs.vector import make_vector_env  # noqa: E402

__all__ = [
    "PixelEnv",
    "SuiteEnv",
    "accept_spaces",
    "default_task",
    "make_env",
    "make_from",
    "make_vector_env",
    "render_info",
    "single_threaded_children",
    "wrap_user_env",
]

choose_backend()  # has to happen before MuJoCo is imported
