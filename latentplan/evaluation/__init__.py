"""What an agent earns in closed loop, in a world that waits or does not, and on goals named at test time."""

from latentplan.evaluation.episodes import evaluate_agent

__all__ = ["evaluate_agent"]
