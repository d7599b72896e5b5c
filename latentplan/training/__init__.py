"""Training runs, distillation of the planner into the actor, and goal conditioning."""

from latentplan.training.distillation.run import distill, resume_distillation
from latentplan.training.goal_conditioning.run import learn_goals, resume_goals
from latentplan.training.train import Result, resume, train

__all__ = ["Result", "distill", "learn_goals", "resume", "resume_distillation", "resume_goals", "train"]
