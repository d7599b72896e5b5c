"""Training runs, distillation of the planner into the actor, and goal conditioning."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from latentplan.config.extras import require_extra

if TYPE_CHECKING:
    from latentplan.training.distillation.run import distill, resume_distillation
    from latentplan.training.goal_conditioning.run import learn_goals, resume_goals
    from latentplan.training.run import Result, resume, train

__all__ = ["Result", "distill", "learn_goals", "resume", "resume_distillation", "resume_goals", "train"]

_MODULES = {
    "run": ("Result", "resume", "train"),
    "distillation.run": ("distill", "resume_distillation"),
    "goal_conditioning.run": ("learn_goals", "resume_goals"),
}


def __getattr__(name: str) -> Any:
    """Imports a function when it is first asked for: collection processes use this package without Lightning."""
    for module, names in _MODULES.items():
        if name in names:
            require_extra("latentplan.training", "lightning", "tensorboard", "rich")
            return getattr(import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
