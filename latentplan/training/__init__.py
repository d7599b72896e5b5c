"""Learning: losses, the Lightning module, collection and the run itself."""

from latentplan.training.run import Result, resume, train

__all__ = ["Result", "resume", "train"]
