"""Evaluation of agents in closed loop: returns, real time by a virtual clock, and goals named at test time."""

from latentplan.config.extras import require_extra

require_extra("latentplan.evaluation", "scipy", "gymnasium")

from latentplan.evaluation.episodes import evaluate_agent  # noqa: E402

__all__ = ["evaluate_agent"]
