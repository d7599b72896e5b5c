"""Learning: losses, the Lightning module, collection, the run itself, and distillation."""

from latentplan.training.distill import distill, resume_distillation
from latentplan.training.run import Result, resume, train

__all__ = ["Result", "distill", "resume", "resume_distillation", "train"]
