"""Evaluation of agents in closed loop: returns, real time by a virtual clock, and goals named at test time."""

from latentplan.evaluation.episodes import evaluate_agent

__all__ = ["evaluate_agent"]
