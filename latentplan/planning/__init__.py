"""Planning in any model: cross-entropy search, objectives, constraints and receding-horizon control.

Imports torch and einops, and of this project only the settings.
"""

from latentplan.planning.adapters import CEMTrajectoryOptimizer
from latentplan.planning.check import check_model
from latentplan.planning.compiled import compile_rollout
from latentplan.planning.conditioned import conditioned
from latentplan.planning.controller import ModelPredictiveController
from latentplan.planning.model import FunctionModel, Model
from latentplan.planning.objectives import (
    Objective,
    Rollout,
    action_penalty,
    at_every_state,
    goal_term,
    learned_return,
    risk,
    smoothness_penalty,
    terminal_value,
    uncertainty_penalty,
)
from latentplan.planning.plan import Plan
from latentplan.planning.realtime.planner import BackgroundPlanner, PlanBuffer
from latentplan.planning.realtime.scheduler import Decision, PlanExecutor, PlanScheduler
from latentplan.planning.realtime.worker import settle
from latentplan.planning.search.cem import CEMPlanner
from latentplan.planning.search.elites import refit
from latentplan.planning.search.family import icem_planner, mppi_planner

__all__ = [
    "BackgroundPlanner",
    "CEMPlanner",
    "CEMTrajectoryOptimizer",
    "Decision",
    "FunctionModel",
    "Model",
    "ModelPredictiveController",
    "Objective",
    "Plan",
    "PlanBuffer",
    "PlanExecutor",
    "PlanScheduler",
    "Rollout",
    "action_penalty",
    "at_every_state",
    "check_model",
    "compile_rollout",
    "conditioned",
    "goal_term",
    "icem_planner",
    "learned_return",
    "mppi_planner",
    "refit",
    "risk",
    "settle",
    "smoothness_penalty",
    "terminal_value",
    "uncertainty_penalty",
]
